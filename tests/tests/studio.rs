//! `snapsnap studio`: requests of its page and of other clients, and the page in a browser.

use std::fs;
use std::io::{BufRead, Cursor, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::path::Path;
use std::thread;
use std::time::Duration;

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

#[cfg(target_os = "linux")]
mod browser {
    use snapsnap_tests::browser::Page;

    use super::*;

    /// The pair over a wall, as JPEG and WebP: with backgrounds.
    fn photographs(folder: &Path) -> [std::path::PathBuf; 2] {
        [("front", "jpg"), ("back", "webp")].map(|(side, extension)| {
            let wall = |_: u32, y: u32| [150.0 + (y / 20) as f32, 160.0, 170.0];
            let over = sample::over(&sample::picture(side), wall);
            let path = folder.join(side).with_extension(extension);
            over.save(&path).expect("written");
            path
        })
    }

    fn open(page: &mut Page, server: &Server) {
        page.ask("Page.navigate", json!({ "url": format!("http://127.0.0.1:{}/", server.port) }));
        page.wait("window.snapsnap !== undefined");
    }

    fn field(side: &str) -> String {
        format!("[data-side={side}] input[type=file]")
    }

    fn is_cut(side: &str) -> String {
        format!("document.querySelector('[data-side={side}]').classList.contains('cut')")
    }

    /// Colour of the canvas of a photograph at shares of its size.
    fn color(page: &mut Page, side: &str, [x, y]: [f64; 2]) -> Vec<u64> {
        let found = page.value(&format!(
            "(() => {{ const c = document.querySelector('[data-side={side}] canvas'); \
             return [...c.getContext('2d').getImageData({x} * c.width, {y} * c.height, 1, 1).data]; }})()"
        ));
        found.as_array().expect("a colour").iter().map(|value| value.as_u64().expect("a byte")).collect()
    }

    /// Photographs are chosen, cut out, corrected by the brush, and become a person that is downloaded.
    #[test]
    fn a_person_is_made_in_the_browser() {
        let Some(mut page) = Page::new(1000, 900) else { return };
        let temporary = tempfile::tempdir().expect("temporary folder");
        let [front, back] = photographs(temporary.path());
        let server = Server::studio(SIDE);
        open(&mut page, &server);
        let shown = "getComputedStyle(document.getElementById('studio')).display !== 'none'";
        assert_eq!(page.value(shown), true);
        assert_eq!(page.value("document.getElementById('make').disabled"), true);

        // A file that is no picture gets a message.
        let text = temporary.path().join("text.png");
        fs::write(&text, "nothing").expect("written");
        page.choose(&field("front"), &text);
        page.wait("document.querySelector('[data-side=front] .message').textContent.includes('not a readable image')");
        assert!(page.errors.iter().all(|error| error.contains("422")), "{:?}", page.errors);
        page.errors.clear();

        page.choose(&field("front"), &front);
        page.wait(&is_cut("front"));
        assert_eq!(page.value("document.getElementById('make').disabled"), true);
        page.choose(&field("back"), &back);
        page.wait(&is_cut("back"));
        assert_eq!(page.value("document.getElementById('make').disabled"), false);

        // The chest is kept, the wall is not. The brush removes a part of the chest, and "Undo" brings it back.
        let (chest, wall) = ([0.5, 0.4], [0.1, 0.4]);
        let (before, behind) = (color(&mut page, "front", chest), color(&mut page, "front", wall));
        assert!(behind[0] > behind[1] + 30, "the background has a red tint: {behind:?}");
        page.value("document.querySelector('[data-side=front] .brush[data-keeps=false]').click()");
        let box_of = page.value(
            "(() => { const b = document.querySelector('[data-side=front] canvas').getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()",
        );
        let [x, y, width, height] = [0, 1, 2, 3].map(|i| box_of[i].as_f64().expect("a number"));
        page.drag([x + 0.48 * width, y + 0.4 * height], [x + 0.52 * width, y + 0.4 * height]);
        let removed = color(&mut page, "front", chest);
        assert!(removed != before && removed[0] > removed[1], "{before:?} {removed:?}");
        page.value("document.querySelector('[data-side=front] .undo').click()");
        assert_eq!(color(&mut page, "front", chest), before);
        // It keeps a part of the wall.
        page.value("document.querySelector('[data-side=front] .brush[data-keeps=true]').click()");
        page.drag([x + 0.08 * width, y + 0.4 * height], [x + 0.12 * width, y + 0.4 * height]);
        let kept = color(&mut page, "front", wall);
        assert!(kept[1] > behind[1] + 50, "{behind:?} {kept:?}");
        page.value("document.querySelector('[data-side=front] .undo').click()");

        // The page shows the progress, then the person.
        page.value(
            "{ window.said = new Set(); const work = document.getElementById('work'); \
             new MutationObserver(() => window.said.add(work.textContent)).observe(work, { childList: true }); \
             document.getElementById('make').click(); }",
        );
        page.wait("document.getElementById('count').textContent.includes('Gaussians')");
        page.wait("document.getElementById('studio').classList.contains('hidden')");
        let said = page.value("[...window.said].join('|')").to_string();
        assert!(said.contains("photographs … ") && said.contains("Gaussians in "), "{said}");
        let yaw = |page: &mut Page| {
            page.value("snapsnap.camera().world_to_camera[0][0]").as_f64().expect("a number")
        };
        assert!((yaw(&mut page) - 1.0).abs() < 1e-3);
        page.press("3", false);
        assert!((yaw(&mut page) + 1.0).abs() < 1e-3);

        // Every download has the server's bytes.
        let links = page.value("[...document.querySelectorAll('#downloads a')].map((link) => link.href)");
        let links: Vec<String> = serde_json::from_value(links).expect("addresses");
        assert_eq!(links.len(), 7);
        for link in &links[..5] {
            let size = page.value(&format!("fetch('{link}').then((a) => a.blob()).then((b) => b.size)"));
            let path = link.split_once(&server.port.to_string()).expect("an address").1;
            assert_eq!(
                size.as_u64(),
                Some(server.ask(&format!("GET {path}"), None).2.len() as u64),
                "{link}"
            );
        }
        // The photographs are still there.
        page.value("document.getElementById('photographs').click()");
        assert_eq!(page.value(shown), true);
        assert_eq!(page.value(&is_cut("front")), true);
        page.value("document.getElementById('again').click()");
        assert_eq!(page.value(&is_cut("front")), false);
        assert!(page.errors.is_empty(), "{:?}", page.errors);
        let own = format!("http://127.0.0.1:{}/", server.port);
        let elsewhere =
            |address: &&String| !["blob:", "data:", own.as_str()].iter().any(|o| address.starts_with(o));
        assert_eq!(page.requests.iter().filter(elsewhere).collect::<Vec<_>>(), Vec::<&String>::new());
    }

    /// From an empty page to a download, by touch alone. One finger scrolls, two paint, and no button covers the person.
    #[test]
    fn a_person_is_made_on_a_telephone() {
        let Some(mut page) = Page::new(390, 844) else { return };
        page.become_telephone(390, 844);
        let temporary = tempfile::tempdir().expect("temporary folder");
        let photographs = photographs(temporary.path());
        let server = Server::studio(SIDE);
        open(&mut page, &server);
        for (side, file) in ["front", "back"].into_iter().zip(&photographs) {
            // As the telephone's own camera returns a picture.
            page.choose(&format!("[data-side={side}] .shoot input"), file);
            page.wait(&is_cut(side));
        }
        let centre = |page: &mut Page| {
            let found = page.value(
                "(() => { const c = document.querySelector('[data-side=front] canvas'); \
                 c.scrollIntoView({ block: 'center' }); const b = c.getBoundingClientRect(); \
                 return [b.x + b.width / 2, b.y + b.height / 2]; })()",
            );
            [0, 1].map(|i| found[i].as_f64().expect("a number"))
        };
        let can_undo = "!document.querySelector('[data-side=front] .undo').disabled";
        let [x, y] = centre(&mut page);
        let two = |step: f64| [[x - 20.0 + step, y + step], [x + 20.0 + step, y + step]];
        page.touch("touchStart", &two(0.0));
        (1..5).for_each(|step| page.touch("touchMove", &two(8.0 * f64::from(step))));
        page.touch("touchEnd", &[]);
        assert_eq!(page.value(can_undo), true, "two fingers paint");
        page.tap("[data-side=front] .undo");
        page.wait(&format!("!({can_undo})"));
        let [x, y] = centre(&mut page);
        let scrolled = "document.getElementById('studio').scrollTop";
        let before = page.value(scrolled).as_f64().expect("a number");
        page.touch("touchStart", &[[x, y]]);
        (1..8).for_each(|step| page.touch("touchMove", &[[x, y - 20.0 * f64::from(step)]]));
        page.touch("touchEnd", &[]);
        page.wait(&format!("{scrolled} > {}", before + 50.0));
        assert_eq!(page.value(can_undo), false, "one finger does not paint");

        let before = color(&mut page, "front", [0.5, 0.4]);
        page.tap("#swap");
        assert_ne!(color(&mut page, "front", [0.5, 0.4]), before, "the back is the front");
        page.tap("#swap");
        assert_eq!(color(&mut page, "front", [0.5, 0.4]), before);
        page.tap("#make");
        page.wait("document.getElementById('studio').classList.contains('hidden')");
        let covered = "(() => { const [c, n] = ['#canvas', 'nav'].map((s) => document.querySelector(s).getBoundingClientRect()); \
                       return c.bottom > n.top && c.right > n.left; })()";
        assert_eq!(page.value(covered), false, "upright");
        page.become_telephone(844, 390);
        page.wait(&format!("!{covered}"));
        let size = page.value(
            "fetch(document.querySelector('#downloads a').href).then((a) => a.blob()).then((b) => b.size)",
        );
        assert!(size.as_u64() > Some(100_000), "{size}");
        assert!(page.errors.is_empty(), "{:?}", page.errors);
    }

    /// The joints are drawn faintly. Feet beyond the border are said, beside the legs.
    #[test]
    fn what_is_wrong_stands_beside_the_limb() {
        let Some(mut page) = Page::new(1000, 900) else { return };
        let temporary = tempfile::tempdir().expect("temporary folder");
        let [whole, _] = photographs(temporary.path());
        let picture = image::open(&whole).expect("a picture");
        let cut = temporary.path().join("cut.jpg");
        picture.crop_imm(0, 0, picture.width(), picture.height() * 3 / 4).save(&cut).expect("written");
        let server = Server::studio(SIDE);
        open(&mut page, &server);
        let mut notes = |file: &Path| {
            page.value("document.querySelector('[data-side=front] .other').click()");
            page.choose(&field("front"), file);
            page.wait(&is_cut("front"));
            let said = page.value("document.querySelector('[data-side=front] .message').textContent");
            let colored = page.value(
                "(() => { const c = document.querySelector('[data-side=front] canvas'); \
                 const { data } = c.getContext('2d').getImageData(0, 0, c.width, c.height); let n = 0; \
                 for (let i = 0; i < data.length; i += 4) n += data[i] === 255 && data[i + 1] === 204 && data[i + 2] === 102; \
                 return n; })()",
            );
            (said.as_str().expect("text").to_owned(), colored.as_u64().expect("a number"))
        };
        assert_eq!(notes(&whole), (String::new(), 0));
        let (said, colored) = notes(&cut);
        assert!(
            said.starts_with("outside of the picture: left leg, right leg") && colored > 500,
            "{said} {colored}"
        );
        assert!(page.errors.is_empty(), "{:?}", page.errors);
    }

    /// Two pages make people at once. One of them has no WebGL: it gets the downloads.
    #[test]
    fn two_pages_do_not_disturb_each_other() {
        let options = ["--disable-gpu", "--disable-webgl", "--disable-3d-apis", "--disable-dev-shm-usage"];
        let Some(mut first) = Page::with_options(390, 800, &options) else { return };
        let mut second = Page::with_options(390, 800, &options).expect("a browser");
        let temporary = tempfile::tempdir().expect("temporary folder");
        let files = photographs(temporary.path());
        let server = Server::studio(SIDE);
        let mut pages = [&mut first, &mut second];
        for page in &mut pages {
            page.ask("Page.navigate", json!({ "url": format!("http://127.0.0.1:{}/", server.port) }));
            page.wait("document.getElementById('studio') !== null && document.querySelectorAll('.photograph').length === 2");
            // Nothing is wider than the screen.
            let width = page.value("document.getElementById('studio').scrollWidth");
            assert!(width.as_f64().is_some_and(|width| width <= 390.0), "{width}");
            for (side, file) in ["front", "back"].into_iter().zip(&files) {
                page.choose(&field(side), file);
            }
        }
        for page in &mut pages {
            page.wait(&is_cut("front"));
            page.wait(&is_cut("back"));
            page.value("document.getElementById('make').click()");
        }
        let mut people = Vec::new();
        for page in &mut pages {
            page.wait("document.getElementById('work').textContent.includes('Gaussians in')");
            people.push(page.value("document.querySelector('#downloads a').href"));
        }
        assert!(people[0] != people[1], "{people:?}");
    }
}
