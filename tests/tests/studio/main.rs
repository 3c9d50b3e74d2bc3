//! `snapsnap studio`: requests of its page and of other clients, and the page in a browser.

#[cfg(target_os = "linux")]
mod browser;

use std::fs;
use std::io::{BufRead, Cursor, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use image::{DynamicImage, GrayImage, ImageFormat, Luma};
use serde_json::{Value, json};
use snapsnap_splat::scene;
use snapsnap_tests::server::Server;
use snapsnap_tests::{sample, snapsnap, succeed};

/// Side of the canvases.
const SIDE: u32 = 256;

fn parts(of: &[&[u8]]) -> (String, Vec<u8>) {
    let lengths: Vec<String> = of.iter().map(|part| part.len().to_string()).collect();
    (format!("X-Parts: {}\r\n", lengths.join(",")), of.concat())
}

/// Makes a person of front, back, and the strokes on each. Returns the person's name.
fn made(server: &Server, of: [&[u8]; 4]) -> String {
    let (header, body) = parts(&of);
    let (status, _, answer) = server.post("/reconstruct", &header, &body);
    assert_eq!(status, 200, "{}", String::from_utf8_lossy(&answer));
    let found: Value = serde_json::from_slice(&answer).expect("JSON");
    assert!(found["gaussians"].as_u64() > Some(1000), "{found}");
    found["name"].as_str().expect("a name").to_owned()
}

fn png(picture: &DynamicImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    picture.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png).expect("encoded");
    bytes
}

/// A page's person has the bytes of `snapsnap reconstruct`, in every format of `snapsnap convert`.
#[test]
fn people_of_the_studio_are_those_of_reconstruct() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path();
    let server = Server::studio(SIDE);
    let [front, back] = sample::paths().map(|path| fs::read(path).expect("the sample"));
    let (status, headers, answer) = server.post("/cutout", "X-Job: 1\r\n", &front);
    assert!(status == 200 && headers.contains("x-parts: "), "{headers}");
    let lengths = headers.lines().find_map(|line| line.strip_prefix("x-parts: ")).expect("lengths");
    let lengths: Vec<usize> =
        lengths.trim().split(',').map(|length| length.parse().expect("a length")).collect();
    let (pictures, seen) = answer.split_at(lengths[0] + lengths[1]);
    let (picture, mask) = pictures.split_at(lengths[0]);
    let seen: Value = serde_json::from_slice(seen).expect("JSON");
    let shoulders = [11, 12].map(|joint| seen["joints"][joint][0].as_f64().expect("a column"));
    assert!((0.5..0.7).contains(&shoulders[0]) && (0.3..0.5).contains(&shoulders[1]), "{seen}");
    assert_eq!(seen["signs"], json!([]));
    let sample_front = image::load_from_memory(&front).expect("a picture").into_rgba8();
    let shown = image::load_from_memory(picture).expect("a picture").into_rgb8();
    let mask = image::load_from_memory(mask).expect("a picture").into_luma8();
    assert_eq!((shown.dimensions(), mask.dimensions()), ((1024, 1024), (1024, 1024)));
    let off = sample_front.pixels().zip(mask.pixels()).filter(|(own, mask)| own[3].abs_diff(mask[0]) > 1);
    assert!(off.count() < 1000, "the mask is the photograph's own, but for specks and rims");

    let name = made(&server, [&front, &back, &[], &[]]);
    let own = folder.join("human.ply");
    let mut reconstruct = sample::reconstruct(folder, &sample::paths());
    succeed(reconstruct.arg("--set").arg(format!("network.resolution={SIDE}")));
    for (path, extension) in [("ply", "ply"), ("spz", "spz"), ("sog", "sog"), ("gaussians.glb", "glb")] {
        let expected = folder.join("expected").with_extension(extension);
        succeed(snapsnap().arg("convert").arg(&own).arg(&expected));
        let (status, headers, content) = server.ask(&format!("GET /people/{name}/scene.{path}"), None);
        assert!(status == 200 && headers.contains(&format!("human.{path}")), "{headers}");
        assert!(content == fs::read(&expected).expect("read"), "{path}");
    }
    let (status, _, mesh) = server.ask(&format!("GET /people/{name}/scene.glb"), None);
    assert!(status == 200 && mesh.starts_with(b"glTF"));
    let (status, _, animation) = server.ask(&format!("GET /people/{name}/scene.gif"), None);
    assert!(status == 200 && animation.starts_with(b"GIF89a"));
    assert_eq!(image::load_from_memory(&animation).expect("a GIF").width(), 512);

    // Strokes remove the head.
    let strokes = GrayImage::from_fn(256, 256, |_, y| Luma([if y < 60 { 0 } else { 128 }]));
    let strokes = png(&strokes.into());
    let headless = made(&server, [&front, &back, &strokes, &strokes]);
    let width = |name: &str| {
        let file = folder.join("person.ply");
        let (status, _, content) = server.ask(&format!("GET /people/{name}/scene.ply"), None);
        assert_eq!(status, 200);
        fs::write(&file, content).expect("written");
        let means = scene::read(&file, &Device::flex()).expect("a PLY").gaussians.means;
        let values: Vec<f32> = means.into_data().try_into_vec().expect("f32");
        let x = || values.chunks_exact(3).map(|point| point[0]);
        x().fold(f32::MIN, f32::max) - x().fold(f32::MAX, f32::min)
    };
    // People are equally high, so that one without a head is wider.
    let [whole, without] = [&name, &headless].map(|name| width(name));
    assert!(without > 1.1 * whole, "{whole} {without}");

    // The server keeps the last four people.
    for _ in 0..3 {
        made(&server, [&front, &back, &[], &[]]);
    }
    let (status, _, message) = server.ask(&format!("GET /people/{name}/scene.ply"), None);
    assert!(status == 404 && String::from_utf8_lossy(&message).contains("no longer in memory"));
    assert_eq!(server.ask(&format!("GET /people/{headless}/scene.ply"), None).0, 200);
}

/// Each address for a device of the local network is good for one. Nobody else gets anything.
#[test]
fn devices_of_the_local_network_join_by_an_address() {
    let (server, mut said) = Server::studio_in_lan(SIDE);
    // The address of the next device, or what the program says instead.
    let mut invited = || {
        let mut line = String::new();
        while !line.starts_with("http://") {
            line.clear();
            assert!(said.read_line(&mut line).expect("text") > 0, "the program ended");
        }
        let host = line.trim().strip_prefix("http://").expect("an address");
        let (host, path) = host.split_once('/').expect("a path");
        (host.to_owned(), format!("/{path}"))
    };
    let (host, path) = invited();
    let address = host.split(':').next().expect("an address").to_owned();
    let ask = |path: &str, host: &str, headers: &str| {
        server.answer_at(&address, format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n").as_bytes())
    };
    assert_eq!(ask("/", &host, "").0, 403, "a device that has not joined");
    assert_eq!(ask("/join/0123", &host, "").0, 403, "another key");
    let near = format!("127.0.0.1:{}", server.port);
    assert_eq!(ask("/", &near, "").0, 403, "another device that names this machine");
    assert_eq!(ask(&path, "evil.example", "").0, 403, "another name of this machine");

    let (status, headers, _) = ask(&path, &host, "");
    let cookie = headers.lines().find_map(|line| line.strip_prefix("set-cookie: ")).expect("a cookie");
    assert!(status == 303 && headers.contains("location: /") && cookie.contains("httponly"), "{headers}");
    let cookie = format!("Cookie: a=b; {}\r\n", cookie.split(';').next().expect("a value"));
    let (status, _, page) = ask("/", &host, &cookie);
    let page = String::from_utf8(page).expect("text");
    assert!(status == 200 && page.contains("class=\"studio\""), "{page}");
    assert_eq!(ask("/", &host, "Cookie: snapsnap=0\r\n").0, 403, "another cookie");
    assert_eq!(
        ask("/", &host, &format!("{cookie}Origin: http://evil.example\r\n")).0,
        200,
        "the page itself"
    );
    let foreign = format!("{cookie}Origin: http://evil.example\r\n");
    assert_eq!(ask("/progress", &host, &foreign).0, 403, "a page of another site");
    assert_eq!(ask("/invitation", &host, &cookie).0, 404, "guests invite nobody");

    assert_eq!(ask(&path, &host, "").0, 403, "the address was for one device");
    let (_, next) = invited();
    assert_ne!(next, path);
    let (status, _, invitation) = server.ask("GET /invitation", None);
    let invitation: Value = serde_json::from_slice(&invitation).expect("JSON");
    assert!(status == 200 && invitation["address"] == format!("http://{host}{next}"), "{invitation}");
    assert!(invitation["picture"].as_str().is_some_and(|picture| picture.contains("<svg")), "{invitation}");
    let page = String::from_utf8(server.ask("GET /", None).2).expect("text");
    assert!(page.contains("class=\"studio inviting\""), "{page}");
    assert_eq!(ask(&next, &host, "").0, 303, "a second device");
}

#[test]
fn unsuitable_requests_are_refused_and_others_served() {
    let server = Server::studio(SIDE);
    let [front, back] = sample::paths().map(|path| fs::read(path).expect("the sample"));
    assert_eq!(server.ask("GET /", None).0, 200);
    let page = String::from_utf8(server.ask("GET /", None).2).expect("text");
    assert!(page.contains("class=\"studio\""), "{page}");
    for path in ["/scene.ply", "/people", "/people/x/scene.xyz", "/people/../scene.ply", "/x"] {
        assert_eq!(server.ask(&format!("GET {path}"), None).0, 404, "{path}");
    }
    assert_eq!(server.ask("PUT /cutout", None).0, 405);
    assert_eq!(server.post("/x", "", b"x").0, 404);
    assert_eq!(server.ask("POST /cutout", None).0, 411, "a body without a length");

    let refused = |path: &str, headers: &str, body: &[u8]| {
        let (status, _, message) = server.post(path, headers, body);
        (status, String::from_utf8(message).expect("text"))
    };
    let (status, message) = refused("/cutout", "", b"no picture");
    assert!(status == 422 && message.contains("not a readable image"), "{message}");
    let (status, message) = refused("/cutout", "", &front[..front.len() / 2]);
    assert!(status == 422 && message.contains("this photograph"), "{message}");
    let black = png(&DynamicImage::new_rgb8(300, 300));
    let (status, message) = refused("/cutout", "", &black);
    assert!(status == 422 && message.contains("no person was found"), "{message}");
    assert_eq!(refused("/cutout", "", &vec![0; 200 << 20]).0, 413);
    let (status, _) = refused("/cutout", "Origin: https://evil.example\r\n", &front);
    assert_eq!(status, 403);
    assert_eq!(refused("/cutout", "Sec-Fetch-Site: cross-site\r\n", &front).0, 403);

    let (header, body) = parts(&[&front, &back, &[], &[]]);
    for wrong in [
        "",
        "X-Parts: 1,2,3\r\n",
        "X-Parts: 1,2,0,0\r\n",
        "X-Parts: -1,0,0,0\r\n",
        "X-Parts: 99999999999999999999,0,0,0\r\n",
    ] {
        assert_eq!(refused("/reconstruct", wrong, &body).0, 400, "{wrong}");
    }
    let told = |fields: &str| refused("/reconstruct", &format!("{header}X-Told: {fields}\r\n"), &body);
    for (fields, expected) in [
        ("{\"height\":\"20\"}", "height 20: must be from 0.1 to 10"),
        ("{\"focal\":\"long\"}", "focal long: is no number"),
        ("{", "the page's fields"),
    ] {
        let (status, message) = told(fields);
        assert!(status == 422 && message.contains(expected), "{fields}: {message}");
    }
    let (with_text, wrong) = parts(&[&front, &back, b"strokes", &[]]);
    let (status, message) = refused("/reconstruct", &with_text, &wrong);
    assert!(status == 422 && message.contains("front strokes"), "{message}");
    let (one, wrong) = parts(&[&front, &black, &[], &[]]);
    let (status, message) = refused("/reconstruct", &one, &wrong);
    assert!(status == 422 && message.contains("back photograph"), "{message}");

    // A cut upload, and clients that announce a long body and send one byte.
    let mut cut = TcpStream::connect(("127.0.0.1", server.port)).expect("connected");
    let head = format!("POST /cutout HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n", server.port);
    write!(cut, "{head}Content-Length: {}\r\n\r\n", front.len()).expect("asked");
    cut.write_all(&front[..1000]).expect("sent");
    cut.shutdown(Shutdown::Write).expect("cut");
    let mut answer = String::new();
    cut.read_to_string(&mut answer).expect("answered");
    assert!(answer.contains(" 400 ") && answer.contains("cut short"), "{answer}");
    #[cfg(target_os = "linux")]
    let before = server.address_space();
    let promised: Vec<TcpStream> = (0..20)
        .map(|_| {
            let mut stream = TcpStream::connect(("127.0.0.1", server.port)).expect("connected");
            write!(stream, "{head}Content-Length: 100000000\r\n\r\nx").expect("asked");
            stream
        })
        .collect();
    // The server has read all headers once it refuses a last request. Allocated bodies would be in its address space.
    assert_eq!(refused("/cutout", "", b"no picture").0, 422);
    thread::sleep(Duration::from_millis(500));
    #[cfg(target_os = "linux")]
    {
        let after = server.address_space();
        assert!(after < before + (1 << 30), "{before} {after}");
    }

    // Two pages at once.
    thread::scope(|scope| {
        let all = [(); 2].map(|()| scope.spawn(|| server.post("/reconstruct", &header, &body)));
        for one in all {
            assert_eq!(one.join().expect("answered").0, 200);
        }
    });
    drop(promised);
}
