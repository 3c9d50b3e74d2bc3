//! The page of `snapsnap studio` in a browser.

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
    page.wait(
        "document.querySelector('[data-side=front] .message').textContent.includes('not a readable image')",
    );
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
    let yaw =
        |page: &mut Page| page.value("snapsnap.camera().world_to_camera[0][0]").as_f64().expect("a number");
    assert!((yaw(&mut page) - 1.0).abs() < 1e-3);
    page.press("3", false);
    assert!((yaw(&mut page) + 1.0).abs() < 1e-3);

    // Every download has the server's bytes.
    let links = page.value("[...document.querySelectorAll('#downloads a')].map((link) => link.href)");
    let links: Vec<String> = serde_json::from_value(links).expect("addresses");
    assert_eq!(links.len(), 8);
    for link in &links[..5] {
        let size = page.value(&format!("fetch('{link}').then((a) => a.blob()).then((b) => b.size)"));
        let path = link.split_once(&server.port.to_string()).expect("an address").1;
        assert_eq!(size.as_u64(), Some(server.ask(&format!("GET {path}"), None).2.len() as u64), "{link}");
    }
    // The person walks.
    let picture = "snapsnap.screenshot().then((blob) => blob.arrayBuffer()).then((bytes) => \
                   new Uint8Array(bytes).reduce((sum, byte) => (31 * sum + byte) | 0, 0))";
    page.value(
        "{ const motion = document.getElementById('motion'); motion.value = 'walk'; \
         motion.dispatchEvent(new Event('input')); }",
    );
    page.wait("!document.getElementById('motion').disabled");
    assert_eq!(page.value("document.getElementById('message').textContent"), "");
    let stride = page.value(picture);
    page.wait(&format!("{picture}.then((next) => next !== {stride})"));
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
    // A tap takes effect a little later, and a tap that ends a scrolling has none.
    let mut swapped = |is_back: bool| {
        let end = Instant::now() + Duration::from_secs(30);
        let mut next = Instant::now();
        while (color(&mut page, "front", [0.5, 0.4]) != before) != is_back {
            assert!(Instant::now() < end, "the back is the front: {is_back}");
            if Instant::now() >= next {
                page.tap("#swap");
                next = Instant::now() + Duration::from_secs(3);
            }
        }
    };
    swapped(true);
    swapped(false);
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
