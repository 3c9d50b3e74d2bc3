//! `snapsnap view`: requests of its own page, of other sites and of misbehaving clients.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use snapsnap_splat::scene;
use snapsnap_tests::ply::balls;
use snapsnap_tests::server::Server;
use snapsnap_tests::{assert_says, data, refused, snapsnap};

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
    // The page gets a PLY for any kind of file. The download has the file's name.
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

    // Clients that send wrong lengths, nothing, or do not read do not block others.
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

    // A reload shows a replaced file and names a broken one.
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
fn pages_of_other_sites_start_no_work() {
    let server = Server::new(&data("spz/v3_degree0.spz"));
    let ask =
        |path: &str, header: &str| server.ask(&format!("GET {path} HTTP/1.1\r\n{header}\r\nX: y"), None).0;
    let own = format!("Origin: http://127.0.0.1:{}", server.port);
    for header in [
        "Origin: https://evil.example",
        "Origin: null",
        "Sec-Fetch-Site: cross-site",
        "Sec-Fetch-Site: same-site",
    ] {
        for path in ["/scene.ply", "/scene.spz", "/scene.glb", "/viewer.js"] {
            assert_eq!(ask(path, header), 403, "{header} {path}");
        }
    }
    for header in [own.as_str(), "Sec-Fetch-Site: same-origin", "Sec-Fetch-Site: none"] {
        assert_eq!(ask("/scene.ply", header), 200, "{header}");
    }
    // A link on another site may open the page.
    assert_eq!(ask("/", "Sec-Fetch-Site: cross-site"), 200);
}

/// Clients that do not read share one copy of the file, and lose their connection to clients that do.
#[cfg(target_os = "linux")]
#[test]
fn clients_that_do_not_read_cost_neither_memory_nor_places() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let file = temporary.path().join("large.ply");
    fs::write(&file, balls((0..800_000_i32).map(|i| [i as f32 * 1e-5, 0.0, 0.0]), -6.0)).expect("written");
    let server = Server::new(&file);
    let size = server.ask("GET /scene.ply", None).2.len() as u64;
    let before = server.memory();
    // All connections but one, so that the server still answers while they are begun.
    let unread: Vec<TcpStream> = (0..64)
        .map(|_| {
            let mut stream = TcpStream::connect(("127.0.0.1", server.port)).expect("connected");
            write!(stream, "GET /scene.ply HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.port)
                .expect("asked");
            stream
        })
        .collect();
    std::thread::sleep(Duration::from_secs(2));
    let after = server.memory();
    assert!(after < before + size, "{before} and {after} bytes for a file of {size}");
    let start = Instant::now();
    let is_served = || {
        let mut stream = TcpStream::connect(("127.0.0.1", server.port)).expect("connected");
        let asked = write!(stream, "GET / HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.port);
        let mut answer = Vec::new();
        asked.and_then(|()| stream.read_to_end(&mut answer)).is_ok() && answer.starts_with(b"HTTP/1.1 200")
    };
    while !is_served() {
        assert!(start.elapsed() < Duration::from_secs(60), "nobody else is served");
        std::thread::sleep(Duration::from_millis(500));
    }
    drop(unread);
}

#[test]
fn what_cannot_be_shown_is_refused_at_once() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    assert_says(&refused(snapsnap().arg("view").arg(temporary.path().join("none.ply"))), &["none.ply"]);
    let file = data("spz/v3_degree0.spz");
    let server = Server::new(&file);
    let taken = server.port.to_string();
    let message = refused(snapsnap().arg("view").arg(&file).args(["--port", &taken]));
    assert!(message.contains("--port") && message.contains("cannot listen"), "{message}");
}
