//! `snapsnap fetch-weights` with servers that break off, ignore ranges or send wrong content.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex};

use snapsnap_tests::{assert_says, data, ended_with, refused, snapsnap, succeed};

const FILE: &str = "lpips-alex-v0.1.pth";

fn published() -> Vec<u8> {
    fs::read(data("lpips").join(FILE)).expect("the learned layers")
}

/// A server on 127.0.0.1. `answer` gets a request's number and the first byte of its range. Returns the server's
/// address and the first bytes of all requests.
fn server(
    answer: impl Fn(usize, Option<usize>) -> Vec<u8> + Send + 'static,
) -> (String, Arc<Mutex<Vec<Option<usize>>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = format!("http://{}/mirror", listener.local_addr().expect("an address"));
    let asked = Arc::new(Mutex::new(Vec::new()));
    let noted = asked.clone();
    std::thread::spawn(move || {
        for (number, stream) in listener.incoming().enumerate() {
            let Ok(mut stream) = stream else { return };
            let mut first = None;
            let lines = BufReader::new(stream.try_clone().expect("a stream")).lines();
            let lines = lines.map_while(Result::ok).take_while(|line| !line.is_empty());
            for (i, line) in lines.enumerate() {
                assert!(i > 0 || line.starts_with(&format!("GET /mirror/{FILE} ")), "{line}");
                if let Some(range) = line.to_lowercase().strip_prefix("range: bytes=") {
                    first = range.trim_end_matches('-').parse().ok();
                }
            }
            noted.lock().expect("unharmed").push(first);
            let _ = stream.write_all(&answer(number, first));
        }
    });
    (address, asked)
}

fn whole(status: &str, body: &[u8]) -> Vec<u8> {
    let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
    [head.as_bytes(), body].concat()
}

/// The answer of a server that supports ranges, after `cut` bytes of the body broken off.
fn ranged(body: &[u8], first: Option<usize>, cut: usize) -> Vec<u8> {
    let from = first.unwrap_or(0);
    let rest = &body[from..];
    let (status, range) = match first {
        Some(_) => (
            "206 Partial Content",
            format!("Content-Range: bytes {from}-{}/{}\r\n", body.len() - 1, body.len()),
        ),
        None => ("200 OK", String::new()),
    };
    let head =
        format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\n{range}Connection: close\r\n\r\n", rest.len());
    [head.as_bytes(), &rest[..cut.min(rest.len())]].concat()
}

fn fetch(from: &str, folder: &Path) -> Command {
    let mut command = snapsnap();
    command.args(["fetch-weights", "lpips", "--from", from, "-o"]).arg(folder);
    command
}

#[test]
fn what_is_fetched_is_shown_before_and_checked_after() {
    let body = published();
    let (address, asked) = server(move |_, first| ranged(&body, first, usize::MAX));
    let temporary = tempfile::tempdir().expect("a folder");
    let folder = temporary.path().join("new/weights");
    let said = succeed(&mut fetch(&address, &folder));
    for part in [
        "6009 bytes",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        "BSD-2-Clause",
        "sound",
    ] {
        assert!(said.contains(part), "{said}");
    }
    assert_eq!(fs::read(folder.join(FILE)).expect("fetched"), published());
    assert_eq!(fs::read_dir(&folder).expect("a folder").count(), 1, "nothing else is left");
    // A sound file is not fetched again, and a wrong file is not replaced.
    assert!(succeed(&mut fetch(&address, &folder)).contains("is there, and sound"));
    fs::write(folder.join(FILE), b"mine").expect("writes");
    assert!(refused(&mut fetch(&address, &folder)).contains("move it away"));
    assert_eq!(fs::read(folder.join(FILE)).expect("kept"), b"mine");
    assert_eq!(asked.lock().expect("unharmed").len(), 1);
    // --list shows all and fetches nothing.
    let said = succeed(snapsnap().args(["fetch-weights", "--list"]));
    assert_says(
        &said,
        &["DUSt3R", "2284790056 bytes", "CC BY-NC-SA", "alexnet-owt", "244408911 bytes", "BSD-3-Clause"],
    );
}

#[test]
fn a_connection_that_breaks_is_gone_on_from_where_it_broke() {
    let body = published();
    let (address, asked) =
        server(move |number, first| ranged(&body, first, if number < 2 { 2500 } else { usize::MAX }));
    let temporary = tempfile::tempdir().expect("a folder");
    succeed(&mut fetch(&address, temporary.path()));
    assert_eq!(fs::read(temporary.path().join(FILE)).expect("fetched"), published());
    assert_eq!(*asked.lock().expect("unharmed"), [None, Some(2500), Some(5000)]);
}

#[test]
fn what_an_ended_run_left_is_gone_on_with() {
    let body = published();
    let (address, asked) = server(move |_, first| ranged(&body, first, usize::MAX));
    let temporary = tempfile::tempdir().expect("a folder");
    fs::write(temporary.path().join(format!("{FILE}.part")), &published()[..4000]).expect("writes");
    succeed(&mut fetch(&address, temporary.path()));
    assert_eq!(fs::read(temporary.path().join(FILE)).expect("fetched"), published());
    assert_eq!(*asked.lock().expect("unharmed"), [Some(4000)]);
    // A server without ranges sends everything again.
    let body = published();
    let (address, _) = server(move |_, _| whole("200 OK", &body));
    let temporary = tempfile::tempdir().expect("a folder");
    fs::write(temporary.path().join(format!("{FILE}.part")), vec![7; 4000]).expect("writes");
    succeed(&mut fetch(&address, temporary.path()));
    assert_eq!(fs::read(temporary.path().join(FILE)).expect("fetched"), published());
}

#[test]
fn what_is_not_the_published_file_is_not_kept() {
    let mut wrong = published();
    wrong[3000] ^= 1;
    let longer = [published(), vec![0; 100_000]].concat();
    for body in [wrong, longer] {
        let (address, _) = server(move |_, first| ranged(&body, first, usize::MAX));
        let temporary = tempfile::tempdir().expect("a folder");
        let said = refused(&mut fetch(&address, temporary.path()));
        assert!(said.contains("the content is not that of") && said.contains("nothing was kept"), "{said}");
        assert_eq!(fs::read_dir(temporary.path()).expect("a folder").count(), 0);
    }
}

#[test]
fn a_server_that_refuses_or_stays_short_is_told() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (address, asked) = server(|_, _| whole("404 Not Found", b"no"));
    assert_says(&ended_with(1, &mut fetch(&address, temporary.path())), &["404"]);
    assert_eq!(asked.lock().expect("unharmed").len(), 1, "what is refused is not asked for again");
    assert_eq!(fs::read_dir(temporary.path()).expect("lists").count(), 0, "nothing is left");
    // A server that stops at half: the first bytes are kept for the next run.
    let body = published();
    let (address, _) = server(move |number, first| ranged(&body, first, if number == 0 { 3000 } else { 0 }));
    assert_says(&ended_with(1, &mut fetch(&address, temporary.path())), &["3000 of 6009 bytes are kept"]);
    let part = fs::read(temporary.path().join(format!("{FILE}.part"))).expect("kept");
    assert_eq!(part, published()[..3000]);
    // No server.
    let said = ended_with(1, &mut fetch("http://127.0.0.1:9", tempfile::tempdir().expect("a folder").path()));
    assert!(said.contains("127.0.0.1"), "{said}");
}

/// A server that never sends the requested range is given up.
#[test]
fn a_server_that_goes_round_in_circles_is_left() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (address, asked) = server(|_, first| match first {
        None => whole("200 OK", &published()[..100]),
        Some(_) => whole("416 Range Not Satisfiable", b""),
    });
    assert_says(&ended_with(1, &mut fetch(&address, temporary.path())), &["of 6009 bytes are kept"]);
    assert!(asked.lock().expect("unharmed").len() < 12, "{asked:?}");
}

#[cfg(unix)]
#[test]
fn what_has_the_name_of_an_unfinished_download_and_is_none_stays() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (victim, part) = (temporary.path().join("victim"), temporary.path().join(format!("{FILE}.part")));
    fs::write(&victim, "mine").expect("writes");
    let (address, _) = server(|_, first| ranged(&published(), first, usize::MAX));
    std::os::unix::fs::symlink(&victim, &part).expect("links");
    assert!(refused(&mut fetch(&address, temporary.path())).contains("is no unfinished download"));
    assert_eq!(fs::read_to_string(&victim).expect("kept"), "mine");
    fs::remove_file(&part).expect("removes");
    // A mirror without the file leaves an unfinished download alone.
    fs::write(&part, "a beginning").expect("writes");
    let empty = tempfile::tempdir().expect("a folder");
    refused(&mut fetch(&empty.path().display().to_string(), temporary.path()));
    assert_eq!(fs::read_to_string(&part).expect("kept"), "a beginning");
}

#[test]
fn a_folder_is_a_mirror_too() {
    let temporary = tempfile::tempdir().expect("a folder");
    let mirror = data("lpips").display().to_string();
    succeed(&mut fetch(&mirror, temporary.path()));
    assert_eq!(fs::read(temporary.path().join(FILE)).expect("copied"), published());
    let empty = tempfile::tempdir().expect("a folder");
    let said = refused(&mut fetch(&empty.path().display().to_string(), &temporary.path().join("b")));
    assert!(said.contains(FILE) && said.contains("cannot read"), "{said}");
    assert_says(&refused(&mut fetch("nowhere", temporary.path())), &["neither a folder nor an address"]);
}
