//! The dashboard in a real browser, Chromium without a screen, which is driven over HTTP by `chromedriver`:
//! every page shows what it should, nothing is fetched from elsewhere, nothing is complained of, and an action does what it says. Needs
//! Debian's packages chromium and chromium-driver; `cargo test --test browser`. Pictures are left in `target/dashboard`.

mod common;

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use common::campaign::Small;
use common::http::{get, request, said};
use common::processes::wait_until;
use common::{Running, program, succeed};
use serde_json::{Value, json};

/// A browser with one window.
struct Browser {
    address: String,
    session: String,
    _driver: Running,
}

impl Browser {
    fn start(dark: bool) -> Self {
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
        let mut arguments =
            vec!["--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1400,1600"];
        arguments.extend(dark.then_some("--force-dark-mode"));
        let wanted = json!({ "alwaysMatch": {
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

    fn show(&self, url: &str) {
        self.tell("/url", &json!({ "url": url }));
    }

    fn run(&self, script: &str) -> Value {
        self.tell("/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script finds something true.
    fn wait(&self, script: &str) {
        wait_until(script, || self.run(&format!("return Boolean({script})")) == true);
    }

    fn log(&self, kind: &str) -> Vec<Value> {
        let Value::Array(lines) = self.tell("/se/log", &json!({ "type": kind })) else { panic!("a list") };
        lines
    }

    /// Leaves a picture for people to look at.
    fn picture(&self, name: &str) {
        let answer = get(&self.address, &format!("/session{}/screenshot", self.session)).json();
        let text = answer["value"].as_str().unwrap();
        let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/dashboard");
        fs::create_dir_all(&directory).unwrap();
        let bytes = from_base64(text);
        assert!(bytes.starts_with(b"\x89PNG"));
        fs::write(directory.join(name), bytes).unwrap();
    }

    /// Every address that pages asked for.
    fn asked_for(&self) -> Vec<String> {
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

/// A campaign that waits for labels from elsewhere: itself, its address and its token.
fn campaign(here: &Path) -> (Running, String, String) {
    let path = Small::default().write(here);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("[label]", "[label]\nslots = 0")).unwrap();
    // What a campaign says is text, whatever it looks like.
    let seeds = fs::read_to_string(here.join("seeds.extxyz")).unwrap();
    fs::write(here.join("seeds.extxyz"), seeds.replace("name=vacancy", "name=\"<b>vacancy</b>\"")).unwrap();
    let mut command = program(here);
    command.args(["run", "campaign.toml", "--dashboard", "127.0.0.1:0"]);
    let mut run = Running(command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap());
    let [said] = said(&mut run.0, ["dashboard at http://"]);
    let (address, token) = said.split_once("/#token=").unwrap();
    wait_until("some structures wait for labels", || {
        let page = get(address, "/api/candidates?state=queued&order=queue").json();
        page["candidates"].as_array().is_some_and(|found| found.len() > 4)
    });
    (run, address.to_owned(), token.to_owned())
}

#[test]
fn every_page_shows_what_it_should_and_nothing_comes_from_elsewhere() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let (_run, address, token) = campaign(here);
    let page = format!("http://{address}/");
    for (dark, colours) in [(false, "light"), (true, "dark")] {
        let browser = Browser::start(dark);
        browser.show(&format!("{page}#token={token}"));
        browser.wait("document.querySelector('#connection').dataset.how === 'live'");
        browser.wait("document.querySelectorAll('.tile').length === 5");
        browser.wait("document.querySelectorAll('figure svg[role=img]').length >= 3");
        assert_eq!(browser.run("return location.hash"), "", "the token is out of the address");
        browser.wait("document.body.textContent.includes('<b>vacancy</b>')");
        browser.picture(&format!("overview-{colours}.png"));
        table(&browser, &page);
        browser.picture(&format!("candidates-{colours}.png"));
        candidate(&browser);
        browser.picture(&format!("candidate-{colours}.png"));
        browser.show(&format!("{page}#hosts"));
        browser.wait("document.querySelector('td .state[data-state=running]')");
        if !dark {
            act(&browser, here, &page);
        }
        let asked = browser.asked_for();
        assert!(asked.len() > 15 && asked.iter().all(|url| url.starts_with(&page)), "{asked:?}");
        let complaints = browser.log("browser");
        assert!(complaints.is_empty(), "{complaints:?}");
    }
}

fn table(browser: &Browser, page: &str) {
    browser.show(&format!("{page}#candidates/fate=accepted"));
    browser.wait("document.querySelectorAll('.candidates tbody tr').length > 4");
    let column = "[...document.querySelectorAll('.candidates tbody tr')].map((row) => Number(row.cells[5].textContent))";
    browser.run(
        "[...document.querySelectorAll('button.sort')].find((b) => b.textContent.includes('γ_max')).click()",
    );
    browser.wait("document.querySelector('th[aria-sort=descending]')?.textContent.includes('γ_max')");
    let found: Vec<f64> = serde_json::from_value(browser.run(&format!("return {column}"))).unwrap();
    assert!(found.len() > 4 && found.is_sorted_by(|a, b| a >= b), "{found:?}");
    assert_eq!(browser.run("return location.hash.includes('order=gamma')"), true);
    assert_eq!(browser.run("return document.querySelectorAll('td b').length"), 0, "text is no markup");
}

fn candidate(browser: &Browser) {
    browser.run("document.querySelector('.candidates tbody a').click()");
    browser.wait("document.querySelectorAll('.atoms tbody tr').length > 20");
    browser.wait("document.querySelector('canvas').width > 300");
    let drawn = "document.querySelector('canvas').toDataURL()";
    let before = browser.run(&format!("return {drawn}"));
    let press = |key: &str| {
        browser.run(&format!(
            "document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))"
        ));
    };
    press("ArrowRight");
    assert_ne!(browser.run(&format!("return {drawn}")), before, "it turns");
    press(".");
    browser.wait("document.querySelector('#picked').textContent.startsWith('Atom 0: Al')");
    assert_eq!(browser.run("return document.querySelectorAll('tr[aria-selected=true]').length"), 1);
}

/// Drops the first structure of the queue.
fn act(browser: &Browser, here: &Path, page: &str) {
    browser.show(&format!("{page}#candidates/order=queue&state=queued"));
    browser.wait("document.querySelectorAll('.candidates tbody a').length > 0");
    let id = browser.run("return document.querySelector('.candidates tbody a').title");
    browser.run("document.querySelector('.candidates tbody a').click()");
    browser.wait("document.querySelector('button.grave')");
    browser.run("document.querySelector('button.grave').click()");
    browser.wait("document.querySelector('dialog[open] input[name=token]')?.value.length === 32");
    let state = || {
        let shown = succeed(here, ["queue", "campaign", "show", id.as_str().unwrap(), "--json"]);
        serde_json::from_str::<Value>(&shown).unwrap()["state"].take()
    };
    assert_eq!(state(), "queued", "nothing is done before it is confirmed");
    browser.run("document.querySelector('dialog button.grave').click()");
    browser.wait("!document.querySelector('dialog')");
    browser.wait("document.querySelector('.head').textContent.includes('dropped')");
    assert_eq!(state(), "dropped");
}
