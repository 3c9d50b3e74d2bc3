//! Archives of a data set.

use super::*;

/// A data set of both splits and its packed form, in archives of one subject each.
fn packed(layout: Layout) -> (tempfile::TempDir, Arc<Folder>, Folder) {
    let (temporary, folder) = small(layout);
    config(layout).add(&folder, &Subject::plain(Split::Val, "0002"), &block()).expect("adds");
    let output = temporary.path().join("packed");
    let done = pack(&folder, &output, 1, |_, _| {}).expect("packs");
    assert_eq!((done.subjects, done.archives), (3, 3));
    let packed = Folder::open(&output).expect("opens");
    (temporary, folder, packed)
}

#[test]
fn a_packed_set_is_read_as_its_folders() {
    for layout in [Layout::Exact, Layout::Authors] {
        let (temporary, folder, packed) = packed(layout);
        assert_eq!(packed.description(), folder.description());
        assert_eq!(packed.splits(), folder.splits());
        for splits in [&[Split::Train, Split::Val][..], &[Split::Val]] {
            assert_eq!(
                packed.fingerprint(splits).expect("reads"),
                folder.fingerprint(splits).expect("reads")
            );
        }
        for split in folder.splits() {
            assert_eq!(packed.subjects(split).expect("lists"), folder.subjects(split).expect("lists"));
            for (subject, view) in
                folder.subjects(split).expect("lists").iter().flat_map(|s| (0..4).map(move |v| (s, v)))
            {
                let of = |folder: &Folder| {
                    let person = folder.person(split, subject);
                    let pictures = [false, true].map(|large| person.picture(view, large).expect("reads"));
                    let map = person.depth(view).expect("reads");
                    (pictures, map.depth, format!("{:?}", map.camera))
                };
                assert!(of(&packed) == of(&folder), "{layout:?}: {subject}, view {view}");
            }
        }
        let checked = check(packed.root(), |_, _| {}).expect("checks");
        assert_eq!((checked.subjects, checked.views, checked.problems), (3, 12, Vec::<String>::new()));
        // The same bytes again; no further packing, and no further subjects.
        let again = temporary.path().join("again_64_4");
        pack(&folder, &again, 1, |_, _| {}).expect("packs");
        for entry in fs::read_dir(packed.root()).expect("lists").map(|entry| entry.expect("entry")) {
            assert!(
                fs::read(entry.path()).expect("reads")
                    == fs::read(again.join(entry.file_name())).expect("reads")
            );
        }
        let refused =
            pack(&packed, &temporary.path().join("third"), 1, |_, _| {}).expect_err("packed").to_string();
        assert!(refused.contains("packed already"), "{refused}");
        let refused = pack(&folder, &again, 1, |_, _| {}).expect_err("there").to_string();
        assert!(refused.contains("again_64_4: is not empty; give another folder"), "{refused}");
        let refused = Folder::create(&again, folder.description().clone()).expect_err("packed").to_string();
        assert!(refused.contains("is packed"), "{refused}");
        let left: Vec<_> =
            fs::read_dir(temporary.path()).expect("lists").map(|e| e.expect("entry").file_name()).collect();
        assert!(left.iter().all(|name| !name.to_string_lossy().starts_with('.')), "{left:?}");
    }
}

#[test]
fn broken_archives_and_indices_are_refused_by_name() {
    let (_temporary, _, packed) = packed(Layout::Exact);
    let root = packed.root();
    let refused = || Folder::open(root).expect_err("refused").to_string();
    let (index, archive) = (root.join("archives.csv"), root.join("train-000001.tar"));
    let (lines, bytes) = (fs::read_to_string(&index).expect("reads"), fs::read(&archive).expect("reads"));

    // Cut, absent, and the archive of another subject in its place.
    for cut in [1, 600, 2000] {
        fs::write(&archive, &bytes[..bytes.len() - cut]).expect("writes");
        assert!(refused().contains("train-000001.tar: has "), "{}", refused());
    }
    fs::remove_file(&archive).expect("removes");
    assert!(refused().contains("train-000001.tar, which is missing"), "{}", refused());
    fs::copy(root.join("train-000000.tar"), &archive).expect("copies");
    if let Ok(folder) = Folder::open(root) {
        let wrong = folder.person(TRAIN, "0001").picture(0, false).expect_err("refused").to_string();
        assert!(wrong.contains("train-000001.tar: has no train/"), "{wrong}");
    }
    fs::write(&archive, &bytes).expect("writes");

    // A damaged header, and a damaged picture.
    let first = folder_line(&lines, "0001.img.0.png");
    let mut changed = bytes.clone();
    changed[first - 512] ^= 1;
    fs::write(&archive, &changed).expect("writes");
    let view = || {
        let folder = Folder::open(root).expect("opens");
        folder.person(TRAIN, "0001").picture(0, false).expect_err("refused").to_string()
    };
    assert!(view().contains("has no train/img/0001/0.png at byte"), "{}", view());
    changed = bytes.clone();
    changed[first + 10] ^= 255;
    fs::write(&archive, &changed).expect("writes");
    assert!(view().contains("train-000001.tar/0001.img.0.png: not a readable image"), "{}", view());
    fs::write(&archive, &bytes).expect("writes");

    fs::write(&index, format!("{lines}train-000000.tar,0009.img.0.png,1048576,10\n")).expect("writes");
    assert!(refused().contains("train-000000.tar: has "), "{}", refused());
    for (line, message) in [
        ("../../train-000000.tar,0000.img.0.png,512,10", "is no file of a data set"),
        ("train-000000.tar,0000.img.../x,512,10", "is no file of a data set"),
        ("train-000000.tar,0000,512,10", "is no file of a data set"),
        ("train-000000.tar,0009.img.0.png,0,10", "`offset` is 0"),
        ("train-000000.tar,0009.img.0.png,513,10", "`offset` is 513"),
        (
            "train-000000.tar,0009.img.0.png,512,18446744073709551615",
            "`length` is 18446744073709551615, more than",
        ),
        ("train-000000.tar,0000.img.0.png,512,10", "is listed twice"),
        ("train-000000.tar,0009.img.0.png,512", "line "),
        ("train-000000.tar,0009.img.0.png,-1,10", "line "),
    ] {
        fs::write(&index, format!("{lines}{line}\n")).expect("writes");
        assert!(
            refused().contains("archives.csv: line ") && refused().contains(message),
            "{line}: {}",
            refused()
        );
    }
    // An index that is cut after or within the lines of an archive, or after the heading; and no index.
    let count = |name: &str| lines.lines().filter(|line| line.starts_with(name)).count();
    let all = lines.lines().count();
    for kept in [all - count("val"), all - 1, 1] {
        let first: Vec<&str> = lines.lines().take(kept).collect();
        fs::write(&index, first.join("\n")).expect("writes");
        assert!(refused().contains(".tar: has ") && refused().contains("by archives.csv"), "{}", refused());
    }
    fs::remove_file(&index).expect("removes");
    assert!(refused().contains("archives.csv: cannot read"), "{}", refused());
    // A file that the index does not list.
    let without: Vec<&str> = lines.lines().filter(|line| !line.contains("0001.depth.3.npz")).collect();
    fs::write(&index, without.join("\n")).expect("writes");
    let missing = check(root, |_, _| {}).expect("checks").problems;
    assert_eq!(missing.len(), 1, "{missing:?}");
    assert!(missing[0].contains("archives.csv: lists no train/depth/0001/3.npz"), "{missing:?}");
    // A killed run leaves no description.
    fs::remove_file(root.join(DESCRIPTION)).expect("removes");
    assert!(refused().contains("is no data set: it has no dataset.toml"), "{}", refused());
}

/// Position of a member in its archive.
fn folder_line(index: &str, member: &str) -> usize {
    let line = index.lines().find(|line| line.contains(member)).expect("listed");
    line.split(',').nth(2).expect("an offset").parse().expect("a number")
}

#[test]
fn a_subject_without_a_file_or_with_a_full_stop_is_not_packed() {
    let (temporary, folder) = small(Layout::Exact);
    let output = temporary.path().join("packed");
    let refused = || pack(&folder, &output, 1 << 30, |_, _| {}).expect_err("refused").to_string();
    let depth = folder.root().join("train/depth/0001/2.npz");
    let content = fs::read(&depth).expect("reads");
    fs::remove_file(&depth).expect("removes");
    assert!(refused().contains("train/depth/0001/2.npz: cannot read"), "{}", refused());
    fs::write(&depth, content).expect("writes");
    for kind in ["img", "depth"] {
        let path = folder.root().join("train").join(kind);
        fs::rename(path.join("0001"), path.join("a.b")).expect("renames");
    }
    assert!(refused().contains("img/a.b: a full stop"), "{}", refused());
    let left: Vec<_> =
        fs::read_dir(temporary.path()).expect("lists").map(|e| e.expect("entry").path()).collect();
    assert_eq!(left, [folder.root()], "nothing is left of it");
}
