//! Draws the pictures of the README in `docs/pictures`, from the campaign of `configs/aluminium.toml` and a longer variant.
//! Needs Debian's packages chromium, chromium-driver, tmux and fonts-dejavu;
//! `cargo test --test external pictures:: -- --ignored`.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::common::browser::Browser;
use crate::common::http::{get, said};
use crate::common::processes::signal;
use crate::common::{Running, demo, program, stderr, succeed};

/// Maximum size of a picture, bytes.
const LARGEST: u64 = 200_000;

/// Columns and lines of the terminal.
const TERMINAL: (u32, u32) = (150, 38);

#[test]
#[ignore = "it overwrites the pictures of the README"]
fn the_readme_shows_a_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let text = demo("aluminium.toml").replace("[campaign]", "[campaign]\nmode = \"live\"");
    // Long enough for the plots over time.
    let text = text
        .replace("biased_steps = 2000", "biased_steps = 12000")
        .replace("# max_per_walk = 3", "max_per_walk = 20");
    fs::write(here.join("aluminium.toml"), text).unwrap();
    let mut command = program(here);
    command.args(["run", "aluminium.toml", "--dashboard", "127.0.0.1:0"]);
    let mut run = Running(command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap());
    let [said] = said(&mut run.0, ["dashboard at http://"]);
    let (address, _) = said.split_once("/#token=").unwrap();
    let browser = Browser::start(false, (1280, 960));
    browser.show(&format!("http://{address}/"));
    let terminal = Terminal::open(here);
    // Wait until a part of the structures is found.
    browser.wait("document.querySelectorAll('.tile strong').length === 5");
    browser.wait("Number(document.querySelectorAll('.tile strong')[2].textContent.split(' ')[0]) >= 30");
    browser.picture(&picture("dashboard"), None);
    let screen = terminal.screen();
    drop(terminal);
    let pages = get(
        address,
        "/api/candidates?order=gamma&fate=accepted&limit=1&where=seed_structure+%3D+%27fcc-100%27",
    )
    .json();
    let id = pages["candidates"][0]["id"].as_str().unwrap().to_owned();
    browser.show(&format!("http://{address}/#candidate/{id}"));
    browser.wait("document.querySelectorAll('.atoms tbody tr').length > 20");
    browser.wait("document.querySelector('canvas').width > 300");
    browser.picture(&picture("candidate"), None);
    signal(run.0.id(), "TERM");
    run.0.wait().unwrap();

    fs::write(here.join("screen.html"), as_html(&screen)).unwrap();
    browser.show(&format!("file://{}", here.join("screen.html").display()));
    browser.picture(&picture("watch"), Some("pre"));
    fs::write(here.join("reported.toml"), demo("aluminium.toml")).unwrap();
    succeed(here, ["run", "reported.toml"]);
    succeed(here, ["report", "reported", "-o", "report"]);
    browser.show(&format!("file://{}", here.join("report/report.html").display()));
    browser.run("document.querySelectorAll('figure')[2].scrollIntoView()");
    browser.picture(&picture("report"), None);
    for name in ["dashboard", "candidate", "watch", "report"] {
        let bytes = fs::metadata(picture(name)).unwrap().len();
        assert!(bytes < LARGEST, "{name}: {bytes} bytes");
    }
}

fn picture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("docs/pictures/{name}.png"))
}

/// `calmwalk watch` in a real terminal.
struct Terminal(String);

impl Terminal {
    fn open(here: &Path) -> Self {
        let terminal = Self(format!("calmwalk-picture-{}", std::process::id()));
        let (width, height) = (TERMINAL.0.to_string(), TERMINAL.1.to_string());
        let command = format!("{} watch aluminium --interval 500ms", env!("CARGO_BIN_EXE_calmwalk"));
        let here = here.display().to_string();
        terminal.tmux(&[
            "-f",
            "/dev/null",
            "new-session",
            "-d",
            "-c",
            &here,
            "-x",
            &width,
            "-y",
            &height,
            &command,
        ]);
        terminal
    }

    fn tmux(&self, arguments: &[&str]) -> String {
        let mut tmux = Command::new("tmux");
        tmux.args(["-u", "-L", &self.0]).args(arguments).env("LC_ALL", "C.UTF-8").env_remove("NO_COLOR");
        let output = tmux.output().expect("tmux is needed: apt-get install tmux");
        assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
        String::from_utf8(output.stdout).expect("text")
    }

    /// The screen with its escape sequences for colours.
    fn screen(&self) -> String {
        self.tmux(&["capture-pane", "-e", "-p"])
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = Command::new("tmux").args(["-L", &self.0, "kill-server"]).output();
    }
}

/// Style of a piece of text in a terminal.
#[derive(Clone, Default)]
struct Style {
    ink: Option<String>,
    ground: Option<String>,
    bold: bool,
    faint: bool,
    turned: bool,
}

/// Converts a terminal's screen to HTML.
fn as_html(screen: &str) -> String {
    let mut page = String::from(
        "<!doctype html><meta charset=utf-8><body style='margin:0'><pre style=\"display:inline-block;margin:0;padding:8px 10px;\
         background:#1b1f24;color:#d7dde3;font:14px/17px 'DejaVu Sans Mono',monospace\">",
    );
    let mut style = Style::default();
    for part in screen.trim_end().split("\u{1b}[") {
        let (codes, text) = part.split_once('m').filter(|(codes, _)| is_codes(codes)).unwrap_or(("", part));
        style.take(codes);
        let text = text.replace('&', "&amp;").replace('<', "&lt;");
        write!(page, "<span style='{}'>{text}</span>", style.css()).unwrap();
    }
    page + "</pre>"
}

fn is_codes(text: &str) -> bool {
    text.chars().all(|c| c.is_ascii_digit() || c == ';')
}

impl Style {
    /// Applies "select graphic rendition" (ECMA-48), as far as terminal programs use it.
    fn take(&mut self, codes: &str) {
        let mut codes = codes.split(';').filter_map(|code| code.parse::<u32>().ok());
        while let Some(code) = codes.next() {
            match code {
                0 => *self = Self::default(),
                1 => self.bold = true,
                2 => self.faint = true,
                22 => (self.bold, self.faint) = (false, false),
                7 => self.turned = true,
                27 => self.turned = false,
                30..=37 => self.ink = Some(colour(code - 30)),
                90..=97 => self.ink = Some(colour(code - 90 + 8)),
                40..=47 => self.ground = Some(colour(code - 40)),
                100..=107 => self.ground = Some(colour(code - 100 + 8)),
                39 => self.ink = None,
                49 => self.ground = None,
                38 | 48 => {
                    let found = match codes.next() {
                        Some(5) => codes.next().map(colour),
                        _ => Some(format!(
                            "rgb({})",
                            codes.by_ref().take(3).map(|part| part.to_string()).collect::<Vec<_>>().join(",")
                        )),
                    };
                    if code == 38 { self.ink = found } else { self.ground = found }
                }
                _ => {}
            }
        }
    }

    fn css(&self) -> String {
        let (mut ink, mut ground) = (self.ink.clone(), self.ground.clone());
        if self.turned {
            (ink, ground) = (ground.or(Some("#1b1f24".into())), ink.or(Some("#d7dde3".into())));
        }
        let mut css = String::new();
        ink.iter().for_each(|ink| css += &format!("color:{ink};"));
        ground.iter().for_each(|ground| css += &format!("background:{ground};"));
        if self.bold {
            css += "font-weight:bold;";
        }
        if self.faint {
            css += "opacity:0.65;";
        }
        css
    }
}

/// One of a terminal's 256 colours; the first 16 are slightly softer variants of xterm's.
fn colour(number: u32) -> String {
    const FIRST: [&str; 16] = [
        "#1b1f24", "#d7605b", "#4fae6f", "#cfa63a", "#5a9fd8", "#b57fc9", "#45b3b8", "#c5ccd3", "#7d8790",
        "#f0837e", "#74cf91", "#e8c462", "#83bdf0", "#d3a3e4", "#71d3d7", "#f4f7fa",
    ];
    match number {
        0..16 => FIRST[number as usize].to_owned(),
        16..232 => {
            let level = |k: u32| [0, 95, 135, 175, 215, 255][(k % 6) as usize];
            let cube = number - 16;
            format!("rgb({},{},{})", level(cube / 36), level(cube / 6), level(cube))
        }
        _ => format!("rgb({0},{0},{0})", 8 + 10 * (number.min(255) - 232)),
    }
}
