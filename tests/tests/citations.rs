//! Every page and heading that a comment or a page cites, and every file that a page links to, is in the repository.

use std::fs;
use std::path::Path;

use snapsnap_tests::root;

/// Folders and files that are read.
const PLACES: &str =
    "crates tests xtask configs docs datasets examples assets README.md CHANGELOG.md CONTRIBUTING.md";
/// Files with these endings are text.
const ENDINGS: [&str; 7] = ["rs", "toml", "md", "py", "sh", "mjs", "js"];
/// Names of pages that the program writes or serves, and of a placeholder.
const OUTPUTS: [&str; 3] = ["report.md", "LICENSES.md", "FILE.md"];

/// The column from which a line is a comment. A Markdown page is one throughout.
fn comment(path: &str, line: &str) -> usize {
    let start = match path.rsplit('.').next() {
        Some("md") => Some(0),
        Some("rs" | "js" | "mjs") => line.find("//"),
        _ => line.find('#'),
    };
    start.unwrap_or(line.len())
}

/// The problem of citing `page` in the file `path`; `rest` is the line behind the citation.
fn problem(path: &str, page: &str, rest: &str) -> Option<String> {
    let folder = Path::new(path).parent().expect("a folder");
    let candidates = [root().join(page), root().join("docs").join(page), root().join(folder).join(page)];
    let Some(file) = candidates.iter().find(|file| file.is_file()) else {
        return Some(format!("there is no page {page}"));
    };
    let (heading, _) = rest.strip_prefix(", \"")?.split_once('"')?;
    let text = fs::read_to_string(file).expect("a page");
    let is_it = |line: &str| line.starts_with('#') && line.trim_start_matches('#').trim() == heading;
    (!text.lines().any(is_it)).then(|| format!("{page} has no heading \"{heading}\""))
}

/// `path:line: problem` of every citation in a file's text, and of every link of a page, that leads nowhere.
fn wrong(path: &str, text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let mut add = |what: String| found.push(format!("{path}:{number}: {what}"));
        for (at, ending) in line.match_indices(".md") {
            let rest = &line[at + ending.len()..];
            let is_part = |c: char| c.is_ascii_alphanumeric() || "_-./".contains(c);
            let start = line[..at].trim_end_matches(is_part).len();
            let page = &line[start..at + ending.len()];
            let is_cited = at >= comment(path, line) || page.starts_with("docs/");
            let is_longer = rest.starts_with(|c: char| c.is_alphanumeric());
            let is_other = page.starts_with('/') || page == ".md" || is_longer;
            if is_cited && !is_other && !OUTPUTS.iter().any(|name| page.ends_with(name)) {
                problem(path, page, rest).into_iter().for_each(&mut add);
            }
        }
        let links = line.split("](").skip(1).filter_map(|rest| rest.split([')', '#']).next());
        for link in links.filter(|link| path.ends_with(".md") && !link.contains("://")) {
            if !root().join(path).with_file_name(link).exists() {
                add(format!("there is no {link}"));
            }
        }
        if line.split("SNAPSNAP").skip(1).any(|rest| rest.is_empty() || rest.starts_with(' ')) {
            add("cites a specification that is not in the repository".into());
        }
    }
    found
}

/// The wrong citations of a file, or of all files below a folder.
fn visit(path: &str) -> Vec<String> {
    let there = root().join(path);
    if there.is_dir() && !path.ends_with("node_modules") {
        let names = fs::read_dir(&there).expect("a folder").map(|entry| entry.expect("an entry").file_name());
        return names.flat_map(|name| visit(&format!("{path}/{}", name.to_string_lossy()))).collect();
    }
    let is_text = ENDINGS.contains(&path.rsplit('.').next().unwrap_or_default());
    // The examples below are wrong on purpose.
    let is_read = is_text && there.is_file() && !path.ends_with("tests/citations.rs");
    if is_read { wrong(path, &fs::read_to_string(&there).expect("text")) } else { Vec::new() }
}

#[test]
fn every_citation_and_every_link_leads_somewhere() {
    let found: Vec<String> = PLACES.split(' ').flat_map(visit).collect();
    assert!(found.is_empty(), "{} citations lead nowhere:\n{}", found.len(), found.join("\n"));
}

#[test]
fn wrong_citations_are_found() {
    let cited = ["docs/absent.md", "docs/method.md, \"Absent\"", "LEARNING.md", "SNAPSNAP §1"];
    let found = cited.map(|cited| wrong("crates/net/src/lib.rs", &format!("//! As in {cited}.")).len());
    assert_eq!(found, [1; 4]);
    assert_eq!(wrong("docs/method.md", "[as here](absent.svg)").len(), 1);
    let right = "//! docs/method.md, \"Ray anchors\", README.md, SNAPSNAP_ROOT, report.md";
    assert!(wrong("crates/net/src/lib.rs", right).is_empty());
}
