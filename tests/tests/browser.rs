//! The page of `snapsnap view` in a browser: its pictures agree with `snapsnap render`.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::{Value, json};
use snapsnap_tests::browser::Page;
use snapsnap_tests::server::Server;
use snapsnap_tests::{assert_says, data, sample, snapsnap, succeed};

const SIDE: u32 = 768;
/// Longest time until a state of the page.
const PATIENCE: Duration = Duration::from_secs(120);
/// Least PSNR between the page and our own render, dB.
const ALIKE: f64 = 25.0;

/// Saves a screenshot as the page's button does, once it no longer changes: the Gaussians are sorted for this camera.
fn screenshot(page: &mut Page, path: &Path) {
    let bytes = |page: &mut Page| {
        let found = page.value(
            "snapsnap.screenshot().then(blob => blob.arrayBuffer()).then(b => Array.from(new Uint8Array(b)))",
        );
        let byte = |value: &Value| value.as_u64().and_then(|v| u8::try_from(v).ok()).expect("a byte");
        found.as_array().expect("bytes").iter().map(byte).collect::<Vec<u8>>()
    };
    let end = Instant::now() + PATIENCE;
    let mut before = bytes(page);
    loop {
        thread::sleep(Duration::from_secs(1));
        let now = bytes(page);
        if now == before {
            return fs::write(path, now).expect("written");
        }
        assert!(Instant::now() < end, "the page never comes to rest");
        before = now;
    }
}

/// Waits until the page stops drawing. Then the middle of the screen, which no button covers, must show what a
/// screenshot shows.
fn check_rest(page: &mut Page, folder: &Path) {
    let end = Instant::now() + PATIENCE;
    let drawn = |page: &mut Page| page.value("snapsnap.renderer.info.render.frame");
    let mut before = drawn(page);
    loop {
        // Longer than the camera is watched after a drag.
        thread::sleep(Duration::from_millis(1500));
        let now = drawn(page);
        if now == before {
            break;
        }
        assert!(Instant::now() < end, "the page never stops drawing");
        before = now;
    }
    let seen = page.ask("Page.captureScreenshot", json!({ "format": "png" }));
    let seen = BASE64_STANDARD.decode(seen["data"].as_str().expect("a picture")).expect("base64");
    let seen = image::load_from_memory(&seen).expect("a picture").into_rgb8();
    let shot = folder.join("rest.png");
    screenshot(page, &shot);
    let shot = image::open(&shot).expect("a picture").into_rgb8();
    assert_eq!(seen.dimensions(), shot.dimensions());
    let middle = SIDE / 3..2 * SIDE / 3;
    let mut all = middle.clone().flat_map(|y| middle.clone().map(move |x| (x, y)));
    let lit = all.clone().filter(|(x, y)| seen.get_pixel(*x, *y).0 != [0; 3]).count();
    assert!(lit > 1000, "only {lit} pixels are lit");
    let close = |a: [u8; 3], b: [u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 1);
    let other = all.find(|(x, y)| !close(seen.get_pixel(*x, *y).0, shot.get_pixel(*x, *y).0));
    assert_eq!(other, None, "the screen shows something else");
}

/// dB between what the page shows and our own render of the file by the page's camera.
fn agreement(page: &mut Page, file: &Path, folder: &Path) -> f64 {
    let folder = tempfile::tempdir_in(folder).expect("temporary folder");
    let [shot, cameras, own] = ["shot.png", "cameras.json", "own"].map(|name| folder.path().join(name));
    screenshot(page, &shot);
    let camera = page.value("[snapsnap.camera()]").to_string();
    fs::write(&cameras, camera).expect("written");
    let mut render = snapsnap();
    render.arg("render").arg(file).arg("--cameras").arg(&cameras).args(["--device", "cpu", "-o"]);
    succeed(render.arg(&own));
    let said = succeed(snapsnap().arg("compare").arg(&shot).arg(own.join("000.png")).arg("--json"));
    let found: Value = serde_json::from_str(&said).expect("JSON");
    let size = image::image_dimensions(&shot).expect("a picture");
    assert_eq!(size, (SIDE, SIDE));
    found["psnr"].as_f64().unwrap_or(f64::INFINITY)
}

/// The camera's degrees around the person and above the horizon, and its distance from the orbit's centre in metres.
fn place(page: &mut Page) -> [f64; 3] {
    let camera = page.value("snapsnap.camera()");
    let entry =
        |row: usize, column: usize| camera["world_to_camera"][row][column].as_f64().expect("a number");
    let centre: [f64; 3] =
        [0, 1, 2].map(|axis| -(0..3).map(|row| entry(row, axis) * entry(row, 3)).sum::<f64>());
    let [x, y, z] = [centre[0], centre[1] - 0.85, centre[2]];
    let away = (x * x + y * y + z * z).sqrt();
    [x.atan2(z).to_degrees(), (y / away).asin().to_degrees(), away]
}

#[test]
fn a_browser_shows_the_person_and_turns_it() {
    let Some(mut page) = Page::new(SIDE, SIDE) else { return };
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path();
    let file = folder.join("human.ply");
    // A software GPU draws one frame a second of the default's 340,000 Gaussians.
    let mut reconstruct = sample::reconstruct(folder, &sample::paths());
    succeed(reconstruct.args(["--set", "network.resolution=256"]));

    let server = Server::new(&file);
    let url = format!("http://127.0.0.1:{}/", server.port);
    page.ask("Page.navigate", json!({ "url": url }));
    page.wait("window.snapsnap !== undefined");
    page.value("snapsnap.ready");
    assert_eq!(page.value("document.getElementById('message').textContent"), "");
    assert_eq!(page.value("document.getElementById('name').textContent"), "human.ply");

    // A grey gradient surrounds the person, lighter above. Our own render has a black background.
    let shot = folder.join("gradient.png");
    screenshot(&mut page, &shot);
    let shot = image::open(&shot).expect("a picture").into_rgb8();
    let [above, below] = [1, SIDE - 2].map(|y| shot.get_pixel(1, y).0);
    assert!(above.iter().zip(below).all(|(a, b)| *a > b + 40 && *a < 180 && b > 60), "{above:?} {below:?}");
    let choose = |value: &str| {
        format!(
            "{{ const chosen = document.getElementById('surround'); chosen.value = '{value}'; \
             chosen.dispatchEvent(new Event('input')); }}"
        )
    };
    page.value(&choose("#000000"));

    // From the front, and after a drag, once the camera is at rest.
    let front = agreement(&mut page, &file, folder);
    check_rest(&mut page, folder);
    let [yaw, pitch, away] = place(&mut page);
    assert!(
        yaw.abs() < 0.1 && (pitch - 8.0).abs() < 0.1 && (away - 2.0).abs() < 0.01,
        "{yaw} {pitch} {away}"
    );
    page.drag([384.0, 384.0], [234.0, 384.0]);
    let turned = agreement(&mut page, &file, folder);
    check_rest(&mut page, folder);
    let [yaw, pitch, _] = place(&mut page);
    // 150 of 768 pixels are 70°, and the camera coasts a little.
    assert!((60.0..150.0).contains(&yaw) && (pitch - 8.0).abs() < 0.1, "{yaw} {pitch}");
    // The wheel moves the camera nearer, a button moves it behind the person.
    let wheel = json!({ "type": "mouseWheel", "x": 384, "y": 384, "deltaX": 0, "deltaY": -240 });
    page.ask("Input.dispatchMouseEvent", wheel);
    let end = Instant::now() + PATIENCE;
    while place(&mut page)[2] > 1.9 {
        assert!(Instant::now() < end, "the wheel brings nothing nearer");
        thread::sleep(Duration::from_millis(50));
    }
    page.value("document.querySelector('button[data-yaw=\"180\"]').click()");
    let back = agreement(&mut page, &file, folder);
    check_rest(&mut page, folder);
    let [yaw, _, away] = place(&mut page);
    assert!(yaw.abs() > 179.9 && (away - 2.0).abs() < 0.01, "{yaw} {away}");
    println!(
        "{front:.1}, {turned:.1} and {back:.1} dB; {}",
        page.value("document.getElementById('rate').textContent")
    );
    assert!(front.min(turned).min(back) >= ALIKE, "{front} {turned} {back}");

    // Arrows rotate, and pan with Shift. Digits choose a side. A double click sets the orbit's centre.
    let close = |a: f64, b: f64| (a - b).abs() < 0.1;
    page.press("1", false);
    page.press("ArrowRight", false);
    page.press("ArrowUp", false);
    let [yaw, pitch, away] = place(&mut page);
    assert!(close(yaw, 5.0) && close(pitch, 13.0) && close(away, 2.0), "{yaw} {pitch} {away}");
    page.press("1", false);
    let centre = |page: &mut Page| page.value("snapsnap.target()");
    let before = centre(&mut page);
    page.press("ArrowLeft", true);
    let after = centre(&mut page);
    let x = |value: &Value| value[0].as_f64().expect("a number");
    assert!((-0.2..-0.05).contains(&(x(&after) - x(&before))), "{before} {after}");
    page.press("1", false);
    // The belly: legs part in the middle of the window.
    for count in [1, 2] {
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({ "type": kind, "x": 384, "y": 320, "button": "left", "clickCount": count });
            page.ask("Input.dispatchMouseEvent", event);
        }
    }
    let after = centre(&mut page);
    let z = after[2].as_f64().expect("a number");
    assert!((0.05..0.3).contains(&z), "{after}");
    // Rotation goes on until it is switched off.
    page.press("1", false);
    page.press("r", false);
    page.wait("(() => { const m = snapsnap.camera().world_to_camera; return Math.abs(m[0][0]) < 0.9; })()");
    page.value("document.getElementById('rotate').click()");
    check_rest(&mut page, folder);
    assert_eq!(page.value("getComputedStyle(document.getElementById('keys')).display"), "none");
    page.press("?", false);
    assert_eq!(page.value("getComputedStyle(document.getElementById('keys')).display"), "block");
    page.press("?", false);

    // The mesh's download shows its progress.
    page.value(
        "{ window.said = new Set(); window.saved = []; const message = document.getElementById('message'); \
         new MutationObserver(() => window.said.add(message.textContent)).observe(message, { childList: true }); \
         HTMLAnchorElement.prototype.click = function () { window.saved.push(this.download); }; }",
    );
    page.value(
        "document.getElementById('mesh').dispatchEvent(new MouseEvent('click', { cancelable: true, bubbles: true }))",
    );
    page.wait("window.saved.length === 1");
    assert_eq!(page.value("window.saved[0]"), "human.glb");
    let said = page.value("[...window.said].join('|')").to_string();
    assert_says(&said, &["Making the mesh: views from all around … ", "texture … "]);

    // The background has the chosen colour.
    page.value(&choose("chosen"));
    page.value(
        "{ const chosen = document.getElementById('background'); chosen.value = '#806040'; \
         chosen.dispatchEvent(new Event('input')); }",
    );
    check_rest(&mut page, folder);
    let shot = folder.join("background.png");
    screenshot(&mut page, &shot);
    let corner = image::open(&shot).expect("a picture").into_rgb8().get_pixel(1, 1).0;
    assert!(corner.iter().zip([128, 96, 64]).all(|(c, chosen)| c.abs_diff(chosen) <= 1), "{corner:?}");

    // A dropped file is shown. An unreadable one gets a message, and the page continues.
    let drop = |name: &str, bytes: &[u8]| {
        format!(
            "{{ const transfer = new DataTransfer();\
             transfer.items.add(new File([new Uint8Array({bytes:?})], '{name}'));\
             window.dispatchEvent(new DragEvent('drop', {{ dataTransfer: transfer, cancelable: true }})); }}"
        )
    };
    let other = fs::read(data("spz/v3_degree0.spz")).expect("read");
    page.value(&drop("other.spz", &other));
    page.wait("document.getElementById('count').textContent === '40 Gaussians'");
    assert!(page.errors.is_empty(), "{:?}", page.errors);
    page.value(&drop("nothing.ply", b"nothing"));
    page.wait("document.getElementById('message').textContent.startsWith('nothing.ply')");
    assert_eq!(page.value("document.getElementById('count').textContent"), "40 Gaussians");

    let elsewhere =
        |address: &&String| !["blob:", "data:", url.as_str()].iter().any(|own| address.starts_with(own));
    let asked: Vec<&String> = page.requests.iter().filter(elsewhere).collect();
    assert!(asked.is_empty() && page.requests.len() > 3, "{asked:?} of {:?}", page.requests);
}

/// Without WebGL the page says so, and its downloads work.
#[test]
fn a_browser_without_webgl_is_told_so() {
    let options = ["--disable-gpu", "--disable-webgl", "--disable-3d-apis", "--disable-dev-shm-usage"];
    let Some(mut page) = Page::with_options(400, 700, &options) else { return };
    let server = Server::new(&data("spz/v3_degree0.spz"));
    page.ask("Page.navigate", json!({ "url": format!("http://127.0.0.1:{}/", server.port) }));
    page.wait("document.getElementById('message')?.textContent.includes('WebGL 2')");
    let link = "document.querySelector('a[href=\"./scene.spz\"]')";
    assert_eq!(page.value(&format!("fetch({link}.href).then(answer => answer.status)")), 200);
}

/// Fingers hit buttons of at least 40 pixels.
#[test]
fn buttons_are_large_on_touch_screens() {
    let Some(mut page) = Page::new(390, 800) else { return };
    page.ask("Emulation.setTouchEmulationEnabled", json!({ "enabled": true }));
    let features = json!({ "features": [{ "name": "pointer", "value": "coarse" }] });
    page.ask("Emulation.setEmulatedMedia", features);
    for (server, least) in [(Server::new(&data("spz/v3_degree0.spz")), 14), (Server::studio(256), 6)] {
        page.ask("Page.navigate", json!({ "url": format!("http://127.0.0.1:{}/", server.port) }));
        page.wait("window.snapsnap !== undefined");
        let sizes = page.value(
            "[...document.querySelectorAll('button, .button')].filter(b => b.getClientRects().length > 0)\
             .map(b => [Math.min(b.offsetWidth, b.offsetHeight), b.getBoundingClientRect().right])",
        );
        let sizes: Vec<[f64; 2]> = serde_json::from_value(sizes).expect("numbers");
        assert!(sizes.len() >= least, "{sizes:?}");
        // All of them are on the screen.
        assert!(sizes.iter().all(|[size, right]| *size >= 40.0 && *right <= 390.0), "{sizes:?}");
    }
}
