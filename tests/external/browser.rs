//! The dashboard in a real browser, headless Chromium driven over HTTP by `chromedriver`: every page shows its content, no
//! other site is contacted, the console has no errors, and actions work. Needs Debian's packages chromium and
//! chromium-driver; `cargo test --test external browser::`. Saves screenshots in `target/dashboard`.

mod states;

use std::fs;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;

use crate::common::browser::{Browser, ENTER, ESCAPE, RIGHT, TAB};
use crate::common::campaign::Small;
use crate::common::http::{get, said};
use crate::common::processes::wait_until;
use crate::common::{Running, program, succeed};

/// Texts of plots that are cut off or that cover another.
const UNREADABLE: &str = "return [...document.querySelectorAll('figure svg')].flatMap((svg) => {
    const [box, name] = [svg.getBoundingClientRect(), svg.closest('figure').querySelector('figcaption').textContent];
    const texts = [...svg.querySelectorAll('text')].map((text) => [text.textContent, text.getBoundingClientRect()]);
    const cut = texts.filter(([, at]) => at.left < box.left - 1 || at.right > box.right + 1 || at.bottom > box.bottom + 1);
    const covered = texts.flatMap(([text, a], k) => texts.slice(k + 1).filter(([, b]) =>
        Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3)
        .map(([other]) => `${name}: ${text} and ${other}`));
    return [...cut.map(([text]) => `${name}: ${text}`), ...covered];
})";

/// Checks that the texts of all plots can be read.
fn plots_are_readable(browser: &Browser, page: &str) {
    assert_eq!(browser.run(UNREADABLE), Value::Array(Vec::new()), "{page}");
}

/// Saves a screenshot for people to check.
fn picture(browser: &Browser, name: &str) {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/dashboard");
    browser.picture(&directory.join(name), None);
}

/// Starts a campaign that waits for external labels. Returns it with its address and token.
fn campaign(here: &Path) -> (Running, String, String) {
    let path = Small::default().write(here);
    let text = fs::read_to_string(&path).unwrap();
    // The queue limit blocks the walkers, so the walks never end.
    fs::write(&path, text.replace("[label]", "[label]\nconcurrency = 0\nqueue_limit = 4")).unwrap();
    // Names must be shown as text, even if they look like markup.
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
        let browser = Browser::start(dark, (1400, 1600));
        browser.show(&format!("{page}#token={token}"));
        browser.wait("document.querySelector('#connection').dataset.how === 'live'");
        browser.wait("document.querySelectorAll('.tile').length === 5");
        browser.wait("document.querySelectorAll('figure svg[role=img]').length >= 3");
        same_time(&browser);
        plots_are_readable(&browser, "overview");
        assert_eq!(browser.run("return location.hash"), "", "the token is out of the address");
        browser.wait("document.body.textContent.includes('<b>vacancy</b>')");
        picture(&browser, &format!("overview-{colours}.png"));
        table(&browser, &page);
        picture(&browser, &format!("candidates-{colours}.png"));
        candidate(&browser);
        picture(&browser, &format!("candidate-{colours}.png"));
        mixture(&browser, &page);
        picture(&browser, &format!("mixture-{colours}.png"));
        browser.show(&format!("{page}#hosts"));
        browser.wait("document.querySelector('td .state[data-state=running]')");
        if !dark {
            act(&browser, here, &page);
            pause(&browser, here, &page);
        }
        let asked = browser.requested_urls();
        assert!(asked.len() > 15 && asked.iter().all(|url| url.starts_with(&page)), "{asked:?}");
        let complaints = browser.log("browser");
        assert!(complaints.is_empty(), "{complaints:?}");
    }
}

/// With all labels: the page of force errors, and elements that might be cut off, which are the tables of a candidate and of
/// the report.
#[test]
fn nothing_is_cut_off_and_errors_are_shown_by_grade() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    succeed(here, ["report", "campaign", "--output", "report"]);
    let report = format!("file://{}", here.join("report/report.html").display());
    let mut command = program(here);
    command.args(["dashboard", "campaign", "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    let page = format!("http://{address}");
    let address = address.trim_end_matches('/');
    let found = get(address, "/api/candidates?order=gamma&fate=accepted&limit=1").json();
    let id = found["candidates"][0]["id"].as_str().unwrap().to_owned();
    let found = get(address, "/api/candidates?fate=control&limit=1").json();
    let control = found["candidates"][0]["id"].as_str().unwrap().to_owned();
    for (dark, colours) in [(false, "light"), (true, "dark")] {
        let browser = Browser::start(dark, (1280, 1600));
        for width in [1280, 800] {
            browser.widen(width);
            browser.show(&format!("{page}#errors"));
            errors(&browser);
            plots_are_readable(&browser, "errors");
            is_not_cut(&browser, ".scrolls");
            picture(&browser, &format!("errors-{colours}-{width}.png"));
            browser.show(&format!("{page}#candidate/{id}"));
            browser.wait("document.querySelectorAll('.atoms tbody tr').length > 20");
            // Columns: atom and element, grades under two mixtures, the neighbourhood grade, and the error.
            browser.wait("document.querySelectorAll('.atoms thead th').length === 6");
            is_not_cut(&browser, ".atoms");
            picture(&browser, &format!("labelled-{colours}-{width}.png"));
            browser.show(&report);
            browser.wait("document.querySelectorAll('#table-seed-structures thead th').length === 14");
            is_not_cut(&browser, ".scroll");
            browser.run("document.querySelector('#table-seed-structures').scrollIntoView()");
            picture(&browser, &format!("report-{colours}-{width}.png"));
        }
        walk_page(&browser, &page);
        narrow(&browser, &page, &id);
        picture(&browser, &format!("narrow-{colours}.png"));
        browser.show(&format!("{page}#candidate/{control}"));
        browser.wait("document.querySelector('.head')");
        let head = browser.run("return document.querySelector('.head').textContent");
        let text = browser.run("return document.querySelector('main').textContent");
        assert_eq!(head.as_str().unwrap().matches("control").count(), 1, "{head}");
        assert!(text.as_str().unwrap().contains("guard requires"), "{text}");
        // A finished campaign is not live.
        browser.wait("document.querySelector('#connection').dataset.how === 'finished'");
        let complaints = browser.log("browser");
        assert!(complaints.is_empty(), "{complaints:?}");
    }
}

/// All plots over time have the same axis, whichever values they show.
fn same_time(browser: &Browser) {
    let axes = "[...document.querySelectorAll('figure svg[role=img]')].filter((one) => one.textContent.includes('local time'))\
                .map((one) => [...one.querySelectorAll('.grid text[text-anchor=middle]')].map((tick) => tick.textContent).join(' '))";
    let axes: Vec<String> = serde_json::from_value(browser.run(&format!("return {axes}"))).unwrap();
    assert!(axes.len() > 1 && axes.windows(2).all(|pair| pair[0] == pair[1]), "{axes:?}");
}

/// The trace of a walk, over steps and over ps.
fn walk_page(browser: &Browser, page: &str) {
    browser.show(&format!("{page}#overview"));
    browser.wait("document.querySelector('a[href=\"#walk/0\"]')");
    browser.run("document.querySelector('a[href=\"#walk/0\"]').click()");
    browser.wait("document.querySelectorAll('figure svg[role=img]').length === 8");
    let text = "return document.querySelector('main').textContent";
    let shown = browser.run(text);
    for words in ["Temperature", "P (GPa)", "V/V₀", "threshold", "τ_r (eV)", "W (eV)", "lengths (Å)"] {
        assert!(shown.as_str().unwrap().contains(words), "{words}: {shown}");
    }
    browser.run("document.querySelector('main input[type=checkbox]').click()");
    browser.wait("document.querySelector('figure').textContent.includes('time (ps)')");
    let shown = browser.run(text);
    assert!(
        !shown.as_str().unwrap().contains("NaN") && !shown.as_str().unwrap().contains("undefined"),
        "{shown}"
    );
}

/// Every page on a narrow screen.
fn narrow(browser: &Browser, page: &str, id: &str) {
    browser.resize(400);
    for (name, is_there) in [
        ("candidates", "document.querySelectorAll('.candidates tbody tr').length > 2"),
        ("mixture", "document.querySelector('button.pick[aria-pressed=true]')"),
        ("errors", "document.querySelectorAll('figure svg[role=img]').length === 6"),
        ("map", "document.querySelectorAll('.map svg a').length > 4"),
        ("hosts", "document.querySelector('main p, main table')"),
        (&format!("candidate/{id}"), "document.querySelectorAll('.atoms tbody tr').length > 20"),
        ("walk/0", "document.querySelectorAll('figure svg[role=img]').length === 8"),
        ("overview", "document.querySelectorAll('.tile').length === 5"),
    ] {
        fits(browser, &format!("{page}#{name}"), is_there);
    }
}

/// Checks that a page fits the width of a telephone.
fn fits(browser: &Browser, url: &str, is_there: &str) {
    browser.show(url);
    browser.wait(is_there);
    let width = browser.run("return document.documentElement.scrollWidth").as_u64().unwrap();
    let shown = browser.run("return document.documentElement.clientWidth").as_u64().unwrap();
    let wide = "[...document.querySelectorAll('main, main *, header, header *')].filter((one) => !one.closest('.scrolls')\
                && one.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map((one) => one.outerHTML.slice(0, 80))";
    assert!(
        width <= shown && shown <= 400,
        "{url}: {width} of {shown}: {}",
        browser.run(&format!("return {wide}"))
    );
    plots_are_readable(browser, url);
}

fn errors(browser: &Browser) {
    browser.wait("document.querySelectorAll('figure svg[role=img]').length === 6");
    let text = browser.run("return document.querySelector('main').textContent");
    let text = text.as_str().unwrap();
    for words in [
        "ρ(γ)",
        "ROC-AUC(γ_nbr)",
        "Force errors by γ_nbr",
        "Biased against control",
        "median (eV/Å)",
        "Labels by V/V₀",
        "RMSE",
        "meV per atom",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    assert!(!text.contains("NaN") && !text.contains("undefined"), "{text}");
}

/// Checks that these elements are visible without scrolling sideways.
fn is_not_cut(browser: &Browser, selector: &str) {
    let cut = format!(
        "[...document.querySelectorAll('{selector}')].filter((one) => one.scrollWidth > one.clientWidth).length"
    );
    assert_eq!(browser.run(&format!("return {cut}")), 0, "{selector}");
    assert!(
        browser.run(&format!("return document.querySelectorAll('{selector}').length")).as_u64() > Some(0)
    );
    let page = "return document.documentElement.scrollWidth <= document.documentElement.clientWidth";
    assert_eq!(browser.run(page), true, "{selector}: the page scrolls sideways");
}

fn table(browser: &Browser, page: &str) {
    browser.show(&format!("{page}#candidates/fate=accepted"));
    browser.wait("document.querySelectorAll('.candidates tbody tr').length > 2");
    browser.run("document.querySelector('.skip').focus()");
    browser.press(&[ENTER]);
    assert_eq!(browser.run("return document.activeElement.id"), "content");
    assert_eq!(browser.run("return location.hash"), "#candidates/fate=accepted", "the page stays");
    browser.press(&[TAB]);
    assert_eq!(browser.run("return document.activeElement.tagName"), "SELECT", "the first filter");
    let sorted = "document.querySelector('th[aria-sort=descending]').cellIndex";
    let column = format!(
        "[...document.querySelectorAll('.candidates tbody tr')].map((row) => Number(row.cells[{sorted}].textContent))"
    );
    // Sort with the keyboard; the focus stays on the button.
    browser.run("document.querySelector('button.sort[data-keep=gamma]').focus()");
    browser.press(&[ENTER]);
    browser.wait("document.querySelector('th[aria-sort=descending]')?.textContent.includes('γ₀_max')");
    assert_eq!(browser.run("return document.activeElement.dataset.keep"), "gamma");
    let found: Vec<f64> = serde_json::from_value(browser.run(&format!("return {column}"))).unwrap();
    assert!(found.len() > 2 && found.is_sorted_by(|a, b| a >= b), "{found:?}");
    assert_eq!(browser.run("return location.hash.includes('order=gamma')"), true);
    assert_eq!(browser.run("return document.querySelectorAll('td b').length"), 0, "text is no markup");
}

fn candidate(browser: &Browser) {
    browser.run("document.querySelector('.candidates tbody a').click()");
    browser.wait("document.querySelectorAll('.atoms tbody tr').length > 20");
    browser.wait("document.querySelector('canvas').width > 300");
    let drawn = "document.querySelector('canvas').toDataURL()";
    let before = browser.run(&format!("return {drawn}"));
    browser.run("document.querySelector('canvas').focus()");
    browser.press(&[RIGHT]);
    assert_ne!(browser.run(&format!("return {drawn}")), before, "it turns");
    browser.press(&['.']);
    browser.wait("document.querySelector('#picked').textContent.startsWith('Atom 0: Al')");
    assert_eq!(browser.run("return document.querySelectorAll('tr[aria-selected=true]').length"), 1);
    browser.press(&['m', '.']);
    browser.wait("document.querySelector('#picked').textContent.includes('Å from atom 0')");
}

/// Drops the first structure of the queue.
fn act(browser: &Browser, here: &Path, page: &str) {
    browser.show(&format!("{page}#candidates/order=queue&state=queued"));
    browser.wait("document.querySelectorAll('.candidates tbody a').length > 0");
    let id = browser.run("return document.querySelector('.candidates tbody a').title");
    browser.run("document.querySelector('.candidates tbody a').click()");
    browser.wait("document.querySelector('button.grave')");
    browser.run("document.querySelector('button.grave').focus()");
    browser.press(&[ENTER]);
    browser.wait("document.querySelector('dialog[open] input[name=token]')?.value.length === 32");
    browser.press(&[ESCAPE]);
    browser.wait("!document.querySelector('dialog')");
    assert_eq!(
        browser.run("return document.activeElement.className"),
        "grave",
        "the focus returns to the button"
    );
    browser.press(&[ENTER]);
    browser.wait("document.querySelector('dialog[open]')?.contains(document.activeElement)");
    let state = || {
        let shown = succeed(here, ["queue", "campaign", "show", id.as_str().unwrap(), "--json"]);
        serde_json::from_str::<Value>(&shown).unwrap()["state"].take()
    };
    assert_eq!(state(), "queued", "nothing is done before it is confirmed");
    browser.press(&[ENTER]);
    browser.wait("!document.querySelector('dialog')");
    browser.wait("document.querySelector('.head').textContent.includes('dropped')");
    browser.wait("document.activeElement.id === 'content'");
    assert_eq!(state(), "dropped");
}

fn mixture(browser: &Browser, page: &str) {
    browser.show(&format!("{page}#mixture"));
    browser.wait("document.querySelector('button.pick[aria-pressed=true]')?.textContent === 'Al'");
    browser.wait(
        "[...document.querySelectorAll('h2')].some((title) => title.textContent === 'Components of Al')",
    );
    // Structures were accepted, so at least one component has moved.
    browser.wait("document.querySelectorAll('svg.length rect').length > 1");
    assert_eq!(browser.run("return document.querySelector('main').textContent.includes('NaN')"), false);
}

/// Pauses the first walk that can be paused with its button, and resumes it.
fn pause(browser: &Browser, here: &Path, page: &str) {
    let paused = || {
        let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
        status["walks"].as_array().unwrap().iter().filter(|walk| walk["paused"] == true).count()
    };
    browser.show(&format!("{page}#overview"));
    for (name, number) in [("Pause", 1), ("Resume", 0)] {
        let button = format!("document.querySelector('button[aria-label^=\"{name} walk\"]')");
        browser.wait(&button);
        browser.run(&format!("{button}.focus(); {button}.click()"));
        browser.wait("document.querySelector('dialog[open] input[name=token]')?.value.length === 32");
        assert_eq!(paused(), 1 - number, "nothing is done before it is confirmed");
        browser.run("document.querySelector('dialog form button:not([type=button])').click()");
        browser.wait("!document.querySelector('dialog')");
        wait_until("the change is stored", || paused() == number);
        if number == 1 {
            browser.wait("document.querySelector('td .state[data-state=paused]')");
            browser.wait("document.activeElement.getAttribute('aria-label')?.startsWith('Resume walk')");
            picture(browser, "paused-light.png");
        }
    }
    browser.wait("!document.querySelector('td .state[data-state=paused]')");
}
