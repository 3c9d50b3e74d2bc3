//! Headless Chromium, controlled by the DevTools protocol: JSON messages that end with a zero byte, over two pipes.

use std::env;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::TempDir;

/// Longest time of a command.
const PATIENCE: Duration = Duration::from_secs(120);

/// A page in a browser of its own, which is killed when this is dropped.
pub struct Page {
    process: Child,
    to: File,
    from: Receiver<Value>,
    last: u64,
    session: Option<String>,
    /// URLs that the page requested.
    pub requests: Vec<String>,
    /// Errors on the page's console, and uncaught errors.
    pub errors: Vec<String>,
    _folder: TempDir,
}

impl Drop for Page {
    fn drop(&mut self) {
        // The browser's helpers are in its process group. Without the program `kill` they end with the browser.
        let group = format!("-{}", self.process.id());
        let _ = Command::new("kill").args(["-KILL", "--", &group]).status();
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The browser's program: `SNAPSNAP_CHROMIUM`, or the first of the usual names on the path.
fn program() -> Option<PathBuf> {
    if let Some(path) = env::var_os("SNAPSNAP_CHROMIUM") {
        return Some(path.into());
    }
    let path = env::var_os("PATH").unwrap_or_default();
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let mut files = env::split_paths(&path).flat_map(|folder| names.map(|name| folder.join(name)));
    files.find(|file| file.is_file())
}

impl Page {
    /// An empty page of `width` × `height` pixels, drawn by a software GPU. Without a browser: `None` and a printed
    /// note, or a panic if `SNAPSNAP_REQUIRE_CHROMIUM` is set.
    pub fn new(width: u32, height: u32) -> Option<Self> {
        Self::with_options(
            width,
            height,
            &["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"],
        )
    }

    /// As [`Self::new`], in a browser with these options.
    pub fn with_options(width: u32, height: u32, options: &[&str]) -> Option<Self> {
        let Some(program) = program() else {
            assert!(env::var_os("SNAPSNAP_REQUIRE_CHROMIUM").is_none(), "no Chromium, but it is required");
            println!("SKIPPED: no Chromium on this machine");
            return None;
        };
        let folder = tempfile::tempdir().expect("temporary folder");
        let pipes = ["to", "from"].map(|name| folder.path().join(name));
        assert!(Command::new("mkfifo").args(&pipes).status().expect("mkfifo").success());
        let script = r#"to=$1 from=$2; shift 2; exec "$@" 3<"$to" 4>"$from""#;
        let mut command = Command::new("sh");
        command.args(["-c", script, "sh"]).args(&pipes).arg(program);
        // Chromium's sandbox needs rights that containers do not have. All pages are our own.
        command.args(["--headless", "--no-sandbox", "--remote-debugging-pipe", "--no-first-run"]);
        command.args(options);
        command.arg(format!("--user-data-dir={}", folder.path().join("profile").display()));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let process = command.process_group(0).spawn().expect("a shell");
        // The shell opens the pipes in this order, too: opening one end waits for the other.
        let to = File::options().write(true).open(&pipes[0]).expect("a pipe");
        let mut reader = BufReader::new(File::open(&pipes[1]).expect("a pipe"));
        let (sender, from) = channel();
        thread::spawn(move || {
            let mut message = Vec::new();
            while reader.read_until(0, &mut message).is_ok_and(|n| n > 1) {
                message.pop();
                let parsed = serde_json::from_slice(&message).expect("JSON");
                message.clear();
                if sender.send(parsed).is_err() {
                    return;
                }
            }
        });
        let (requests, errors) = (Vec::new(), Vec::new());
        let mut page = Self { process, to, from, last: 0, session: None, requests, errors, _folder: folder };
        let target = page.ask("Target.createTarget", json!({ "url": "about:blank" }));
        let attached = json!({ "targetId": target["targetId"], "flatten": true });
        let session = page.ask("Target.attachToTarget", attached);
        page.session = session["sessionId"].as_str().map(str::to_owned);
        for domain in ["Runtime", "Log", "Network", "Page"] {
            page.ask(&format!("{domain}.enable"), json!({}));
        }
        let size = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        page.ask("Emulation.setDeviceMetricsOverride", size);
        Some(page)
    }

    /// Sends a command of the protocol and waits for its result.
    pub fn ask(&mut self, method: &str, parameters: Value) -> Value {
        self.last += 1;
        let mut message = json!({ "id": self.last, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        self.to.write_all(&bytes).unwrap_or_else(|e| panic!("{method}: {e}"));
        let end = Instant::now() + PATIENCE;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            let answer = self.from.recv_timeout(left);
            let answer = answer.unwrap_or_else(|e| panic!("{message}: {e}; errors: {:?}", self.errors));
            self.hear(&answer);
            if answer["id"] == json!(self.last) {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
        }
    }

    fn hear(&mut self, event: &Value) {
        let about = &event["params"];
        match event["method"].as_str() {
            Some("Network.requestWillBeSent") => {
                self.requests.push(about["request"]["url"].as_str().expect("an address").to_owned());
            }
            Some("Runtime.exceptionThrown") => self.errors.push(about["exceptionDetails"].to_string()),
            Some("Runtime.consoleAPICalled") if about["type"] == "error" => {
                self.errors.push(about["args"].to_string());
            }
            Some("Log.entryAdded") if about["entry"]["level"] == "error" => {
                self.errors.push(about["entry"].to_string());
            }
            _ => {}
        }
    }

    /// The value of a JavaScript expression. A promise is awaited.
    pub fn value(&mut self, expression: &str) -> Value {
        let wanted = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let found = self.ask("Runtime.evaluate", wanted);
        assert!(found["exceptionDetails"].is_null(), "{expression}: {}", found["exceptionDetails"]);
        found["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn wait(&mut self, expression: &str) {
        let end = Instant::now() + PATIENCE;
        while self.value(expression) != json!(true) {
            assert!(Instant::now() < end, "never true: {expression}; errors: {:?}", self.errors);
            thread::sleep(Duration::from_millis(50));
        }
    }

    /// Chooses a file in the input field of a CSS selector.
    pub fn choose(&mut self, selector: &str, file: &Path) {
        let field = format!("document.querySelector({})", json!(selector));
        let found = self.ask("Runtime.evaluate", json!({ "expression": field }));
        let files = json!({ "files": [file], "objectId": found["result"]["objectId"] });
        self.ask("DOM.setFileInputFiles", files);
    }

    /// Presses a key, named as in the browser's events, with Shift or without.
    pub fn press(&mut self, key: &str, shift: bool) {
        for kind in ["keyDown", "keyUp"] {
            let event = json!({ "type": kind, "key": key, "modifiers": if shift { 8 } else { 0 } });
            self.ask("Input.dispatchKeyEvent", event);
        }
    }

    /// Makes it a telephone's page of `width` × `height` pixels, with a touch screen.
    pub fn become_telephone(&mut self, width: u32, height: u32) {
        let size = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": true });
        self.ask("Emulation.setDeviceMetricsOverride", size);
        self.ask("Emulation.setTouchEmulationEnabled", json!({ "enabled": true, "maxTouchPoints": 2 }));
    }

    /// An event of the touch screen (`touchStart`, `touchMove` or `touchEnd`) with the fingers at these places.
    pub fn touch(&mut self, kind: &str, fingers: &[[f64; 2]]) {
        let points = fingers.iter().enumerate().map(|(id, [x, y])| json!({ "x": x, "y": y, "id": id }));
        let event = json!({ "type": kind, "touchPoints": points.collect::<Vec<_>>() });
        self.ask("Input.dispatchTouchEvent", event);
    }

    /// Taps the element of a CSS selector.
    pub fn tap(&mut self, selector: &str) {
        let place = self.value(&format!(
            "(() => {{ const e = document.querySelector({}); e.scrollIntoView({{ block: 'center' }}); \
             const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; }})()",
            json!(selector)
        ));
        let place = [0, 1].map(|i| place[i].as_f64().expect("a number"));
        self.touch("touchStart", &[place]);
        self.touch("touchEnd", &[]);
    }

    /// Drags the left mouse button from one place of the page to another, in pixels.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        const STEPS: i32 = 5;
        let place =
            |step: i32| [0, 1].map(|c| from[c] + (to[c] - from[c]) * f64::from(step) / f64::from(STEPS));
        let mut mouse = |kind: &str, [x, y]: [f64; 2]| {
            let event =
                json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
            self.ask("Input.dispatchMouseEvent", event);
        };
        mouse("mousePressed", from);
        (1..=STEPS).for_each(|step| mouse("mouseMoved", place(step)));
        mouse("mouseReleased", to);
    }
}
