//! What pages say of a campaign without walks, of one that is stopped and has failed labels, of questions that have no answer, and when
//! the database or the program no longer answers. The scripts choose these words, so only a browser shows them; one session sees all.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use serde_json::json;
use store::{CampaignRecord, Store};
use wire::CampaignId;

use super::{campaign, picture};
use crate::common::browser::Browser;
use crate::common::http::said;
use crate::common::processes::signal;
use crate::common::{Running, program};

/// Names of pages, with what each says.
type Says<'a> = &'a [(&'a str, &'a [&'a str])];

const EMPTY: Says = &[
    (
        "overview",
        &[
            "stopped: no run is active",
            "none yet",
            "none seen yet",
            "No walk has begun.",
            "No candidate has been found yet.",
        ],
    ),
    ("candidates", &["No candidate matches."]),
    ("map", &["No structure has been collected yet."]),
    ("mixture", &["the store has no path of potential.model"]),
    ("errors", &["the campaign has no label protocol, and so no labels"]),
    ("hosts", &["This campaign has no processes."]),
    ("walk/7", &["the campaign has no walk 7; no walk has started yet"]),
    ("candidate/nobody", &["'nobody'"]),
];

const STOPPED: Says = &[
    ("overview", &["stopped: no run is active", "unfinished", "Label failures by class", "node failure"]),
    ("candidates/state=failed", &["failed", "page 1"]),
    ("candidates/state=leased", &["No candidate matches."]),
    ("candidates/where=gama+%3E+1", &["at character 1: found 'gama'", "gamma_nbr"]),
    ("candidates/where=fragments+%3E+1", &["does not know 'fragments'", "calmwalk export --where"]),
    ("candidates/order=size", &["order is 'size', expected one of decision"]),
    ("errors", &["No candidate has a label yet."]),
    ("hosts", &["This campaign has no processes."]),
];

#[test]
fn pages_explain_what_is_missing() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let browser = Browser::start(false, (1400, 1000));
    create(&here.join("empty"));
    let (mut server, page) = dashboard(here, "empty");
    check(&browser, &page, EMPTY, "empty");
    fs::write(here.join("empty").join(store::DATABASE), "no database").unwrap();
    browser.wait("document.querySelector('#connection').textContent === '○ the database does not answer'");
    server.0.kill().unwrap();
    browser.wait("document.querySelector('#connection').textContent === '○ no connection: retrying'");
    check(&browser, &page, &[("candidates", &["no connection to the program"])], "lost");

    stopped_with_failed_labels(here);
    let (_server, page) = dashboard(here, "campaign");
    check(&browser, &page, STOPPED, "stopped");
}

/// A campaign that has never run.
fn create(directory: &Path) {
    let record = CampaignRecord {
        id: CampaignId([7; 16]),
        program_version: "0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    fs::create_dir(directory).unwrap();
    let create = async {
        Store::create(directory, &record, &[], 0).await.unwrap().close().await;
    };
    tokio::runtime::Runtime::new().unwrap().block_on(create);
}

/// A campaign whose first labels fail, and which is stopped then.
fn stopped_with_failed_labels(here: &Path) {
    let (mut run, ..) = campaign(here);
    signal(run.0.id(), "TERM");
    run.0.wait().unwrap();
    let fail = async {
        let store = Store::open(here.join("campaign").as_path()).await.unwrap();
        let protocol = store.protocol_in_force().await.unwrap().unwrap();
        for _ in 0..2 {
            let lease = store.lease(protocol.hash, "host/a", 0, 600).await.unwrap().unwrap();
            store.fail(&lease, "node_failure", "gone", 1, 0).await.unwrap();
        }
        store.close().await;
    };
    tokio::runtime::Runtime::new().unwrap().block_on(fail);
}

/// The program that shows a campaign, with its address.
fn dashboard(here: &Path, campaign: &str) -> (Running, String) {
    let mut command = program(here);
    command.args(["dashboard", campaign, "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    (shown, format!("http://{}/", address.trim_end_matches('/')))
}

/// Every page says what it should, and nothing that a script would write by mistake.
fn check(browser: &Browser, page: &str, says: Says, name: &str) {
    for (of, words) in says {
        browser.show(&format!("{page}#{of}"));
        let all = format!("{}.every((word) => document.body.textContent.includes(word))", json!(words));
        browser.wait(&all);
        let text = browser.run("return document.querySelector('main').textContent");
        let text = text.as_str().unwrap();
        let slip = ["undefined", "NaN", "null", "[object"].into_iter().find(|slip| text.contains(slip));
        assert_eq!(slip, None, "{of}: {text}");
        picture(browser, &format!("{name}-{}.png", of.replace(['/', '=', '+', '%'], "-")));
    }
}
