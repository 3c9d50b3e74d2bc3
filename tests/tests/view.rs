//! `snapsnap view`, as a browser and as somebody else would ask it.

use std::fs;
use std::io::Write;
use std::net::TcpStream;

use burn::tensor::Device;
use snapsnap_splat::scene;
use snapsnap_tests::server::Server;
use snapsnap_tests::{data, refused, snapsnap};

#[test]
fn the_page_and_its_file_are_served_to_this_machine_alone() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let file = temporary.path().join("die Prüfung.spz");
    fs::copy(data("spz/v3_degree0.spz"), &file).expect("copied");
    let server = Server::new(&file);
    let (status, headers, page) = server.ask("GET /", None);
    assert_eq!(status, 200);
    assert!(headers.contains("text/html") && headers.contains("default-src 'none'"), "{headers}");
    let page = String::from_utf8(page).expect("text");
    for part in ["./viewer.js", "./viewer.css", "data-yaw=\"180\"", "id=\"background\"", "scene.spz"] {
        assert!(page.contains(part), "{part}");
    }
    for (path, kind) in
        [("/viewer.js?x", "javascript"), ("/viewer.css", "text/css"), ("/LICENSES.md", "markdown")]
    {
        let (status, headers, content) = server.ask(&format!("GET {path}"), None);
        assert!(status == 200 && headers.contains(kind) && !content.is_empty(), "{path}: {headers}");
    }
    // Whatever kind the file is, the page gets a PLY; the download has its name.
    let (status, headers, content) = server.ask("GET /scene.ply", None);
    assert!(status == 200 && headers.contains("die%20pr%c3%bcfung.ply"), "{headers}");
    let ply = temporary.path().join("got.ply");
    fs::write(&ply, content).expect("written");
    assert_eq!(scene::read(&ply, &Device::flex()).expect("a PLY").gaussians.len(), 40);
    let (status, _, content) = server.ask("GET /scene.spz", None);
    assert!(status == 200 && content.starts_with(&[0x1f, 0x8b]));
    let (status, _, content) = server.ask("HEAD /scene.spz", None);
    assert!(status == 200 && content.is_empty());

    for path in [
        "/x",
        "/../Cargo.toml",
        "/%2e%2e/Cargo.toml",
        "//etc/passwd",
        "/scene",
        "/index.html/",
        "/viewer.js/",
    ] {
        assert_eq!(server.ask(&format!("GET {path}"), None).0, 404, "{path}");
    }
    assert_eq!(server.ask("POST /scene.ply", None).0, 405);
    assert_eq!(server.ask("GET /scene.ply", Some("evil.example")).0, 403);
    assert_eq!(server.ask("GET /", Some(&format!("localhost:{}", server.port))).0, 200);

    assert_eq!(server.ask("GET /", Some(&format!("LocalHost:{}", server.port))).0, 200);
    assert_eq!(server.ask(&format!("GET http://127.0.0.1:{}/viewer.css", server.port), None).0, 200);
    assert_eq!(server.ask("GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: y", None).0, 400);
    assert_eq!(server.ask(&format!("GET /{}", "x".repeat(20_000)), None).0, 431);
    assert_eq!(server.ask("nonsense\r\n", None).0, 400);

    // Whatever clients promise, withhold or leave unread, others are served.
    let connect = || TcpStream::connect(("127.0.0.1", server.port)).expect("connected");
    let idle: Vec<TcpStream> = (0..20).map(|_| connect()).collect();
    let unread: Vec<TcpStream> = (0..8).map(|_| connect()).collect();
    for mut stream in &unread {
        write!(stream, "GET /viewer.js HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.port).expect("asked");
    }
    for length in ["99999999999999", "18446744073709551615", "2000"] {
        let request = format!("GET / HTTP/1.1\r\nContent-Length: {length}\r\nX: y");
        assert_eq!(server.ask(&request, None).0, 200, "{length}");
    }
    drop((idle, unread));

    // What is replaced is shown on reload, and what is broken says so.
    fs::copy(data("spz/v3_degree3.spz"), &file).expect("copied");
    let (_, _, content) = server.ask("GET /scene.ply", None);
    fs::write(&ply, content).expect("written");
    assert_eq!(scene::read(&ply, &Device::flex()).expect("a PLY").gaussians.len(), 24);
    fs::write(&file, "nothing").expect("written");
    let (status, _, content) = server.ask("GET /scene.ply", None);
    assert_eq!(status, 422);
    assert!(String::from_utf8_lossy(&content).contains("Prüfung.spz"));
    assert_eq!(server.ask("GET /", None).0, 200);
    fs::remove_file(&file).expect("removed");
    assert_eq!(server.ask("GET /scene.ply", None).0, 422);
}

#[test]
fn what_cannot_be_shown_is_refused_at_once() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let message = refused(snapsnap().arg("view").arg(temporary.path().join("none.ply")));
    assert!(message.contains("none.ply"), "{message}");
    let file = data("spz/v3_degree0.spz");
    let server = Server::new(&file);
    let taken = server.port.to_string();
    let message = refused(snapsnap().arg("view").arg(&file).args(["--port", &taken]));
    assert!(message.contains("--port") && message.contains("cannot listen"), "{message}");
}
