//! Drives headless Chromium over HTTP with `chromedriver`. Debian's packages are chromium and chromium-driver.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::{Value, json};

use super::Running;
use super::http::{get, request};
use super::processes::wait_until;

/// WebDriver codes of special keys.
pub const TAB: char = '\u{e004}';
pub const ENTER: char = '\u{e007}';
pub const ESCAPE: char = '\u{e00c}';
pub const RIGHT: char = '\u{e014}';

/// A browser with one window.
pub struct Browser {
    address: String,
    session: String,
    _driver: Running,
}

impl Browser {
    /// Opens a window of this size with a dark or light theme.
    pub fn start(dark: bool, (width, height): (u32, u32)) -> Self {
        let driver = Command::new("chromedriver").arg("--port=0").stdout(Stdio::piped()).spawn();
        let mut driver = Running(driver.expect("chromedriver, of Debian's package chromium-driver"));
        let mut lines = BufReader::new(driver.0.stdout.take().unwrap()).lines();
        let port = lines.find_map(|line| {
            let line = line.unwrap();
            Some(line.split_once("started successfully on port ")?.1.trim_end_matches('.').to_owned())
        });
        std::thread::spawn(move || lines.for_each(drop));
        let address = format!("127.0.0.1:{}", port.expect("chromedriver says its port"));
        let mut browser = Self { address, session: String::new(), _driver: driver };
        let size = format!("--window-size={width},{height}");
        let mut arguments =
            vec!["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", &size];
        arguments.extend(dark.then_some("--force-dark-mode"));
        let wanted = json!({ "alwaysMatch": {
            // A busy machine may exceed the default script timeout of 30 s.
            "timeouts": { "script": 300_000, "pageLoad": 300_000 },
            "goog:chromeOptions": { "args": arguments },
            "goog:loggingPrefs": { "browser": "ALL", "performance": "ALL" },
        } });
        let session = browser.tell("", &json!({ "capabilities": wanted }));
        browser.session = format!("/{}", session["sessionId"].as_str().unwrap());
        browser
    }

    fn tell(&self, what: &str, body: &Value) -> Value {
        let path = format!("/session{}{what}", self.session);
        let headers = [("Content-Type", "application/json")];
        let answer = request(&self.address, "POST", &path, &headers, &body.to_string());
        assert_eq!(answer.status, 200, "{what} {body}: {answer:?}");
        answer.json()["value"].take()
    }

    /// Opens a URL.
    pub fn show(&self, url: &str) {
        self.tell("/url", &json!({ "url": url }));
    }

    /// Sets the width of the window.
    pub fn widen(&self, width: u32) {
        self.tell("/window/rect", &json!({ "width": width, "height": 1600 }));
    }

    /// Sets the width of pages, which may be below the minimum width of a window.
    pub fn resize(&self, width: u32) {
        let parameters = json!({ "width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false });
        self.tell(
            "/goog/cdp/execute",
            &json!({ "cmd": "Emulation.setDeviceMetricsOverride", "params": parameters }),
        );
    }

    /// Returns the result of a script.
    pub fn run(&self, script: &str) -> Value {
        self.tell("/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script returns a true value.
    pub fn wait(&self, script: &str) {
        wait_until(script, || self.run(&format!("return Boolean({script})")) == true);
    }

    /// Presses keys one after the other. The focused element receives them.
    pub fn press(&self, keys: &[char]) {
        let strokes = keys
            .iter()
            .flat_map(|key| ["keyDown", "keyUp"].map(|kind| json!({ "type": kind, "value": key })));
        let keyboard = json!({ "type": "key", "id": "keyboard", "actions": strokes.collect::<Vec<_>>() });
        self.tell("/actions", &json!({ "actions": [keyboard] }));
    }

    /// Lines of one of the browser's logs.
    pub fn log(&self, kind: &str) -> Vec<Value> {
        let Value::Array(lines) = self.tell("/se/log", &json!({ "type": kind })) else { panic!("a list") };
        lines
    }

    /// Saves a screenshot of the window, or of one element (a CSS selector), as PNG.
    pub fn picture(&self, file: &Path, of: Option<&str>) {
        let of = of.map(|selector| {
            let found = self.tell("/element", &json!({ "using": "css selector", "value": selector }));
            let id = found.as_object().unwrap().values().next().unwrap().as_str().unwrap().to_owned();
            format!("/element/{id}")
        });
        let path = format!("/session{}{}/screenshot", self.session, of.unwrap_or_default());
        let answer = get(&self.address, &path).json();
        let bytes = from_base64(answer["value"].as_str().unwrap());
        assert!(bytes.starts_with(b"\x89PNG"));
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, bytes).unwrap();
    }

    /// Every URL that pages requested.
    pub fn requested_urls(&self) -> Vec<String> {
        let asked = |line: Value| -> Option<String> {
            let message: Value = serde_json::from_str(line["message"].as_str()?).ok()?;
            let is_request = message["message"]["method"] == "Network.requestWillBeSent";
            let url = message.pointer("/message/params/request/url")?.as_str()?.to_owned();
            is_request.then_some(url)
        };
        self.log("performance").into_iter().filter_map(asked).collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        if !self.session.is_empty() {
            request(&self.address, "DELETE", &format!("/session{}", self.session), &[], "");
        }
    }
}

fn from_base64(text: &str) -> Vec<u8> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = text.bytes().filter(|c| *c != b'=').map(digit).collect();
    let bytes = digits.chunks(4).flat_map(|four| {
        let number = four.iter().fold(0u32, |sum, d| (sum << 6) | u32::from(*d)) << (6 * (4 - four.len()));
        number.to_be_bytes()[1..four.len()].to_vec()
    });
    bytes.collect()
}
