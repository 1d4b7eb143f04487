//! The dashboard of a running campaign and of a read-only copy: pages, events, the table, candidates, and actions, which need
//! the token and are refused to pages of other sites.

use std::collections::BTreeSet;
use std::fs;
use std::io::BufReader;
use std::path::Path;
use std::process::Stdio;

use atoms::extxyz::ExtxyzReader;
use atoms::poscar::read_poscar;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::http::{first_event, get, get_computed, request, said};
use crate::common::processes::wait_until;
use crate::common::{Running, config, program, refuse, succeed};

/// A running campaign that waits for external labels.
struct Live {
    directory: TempDir,
    _run: Running,
    address: String,
    token: String,
}

impl Live {
    /// A campaign that has collected all its structures.
    fn begin() -> Self {
        let live = Self::labelling("concurrency = 0");
        wait_until("all structures are collected", || {
            let status = live.status();
            let over = |walk: &Value| !["waiting", "running"].contains(&walk["state"].as_str().unwrap());
            let walks = status["walks"].as_array().unwrap();
            walks.len() >= 2 && walks.iter().all(over) && status["labels"]["queued"].as_u64() > Some(2)
        });
        live
    }

    /// Adds lines to the section `[label]`.
    fn labelling(label: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        let path = Small::default().write(here);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replace("[label]", &format!("[label]\n{label}"))).unwrap();
        let mut command = program(here);
        command.args(["run", "campaign.toml", "--dashboard", "127.0.0.1:0"]);
        let mut run = Running(command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap());
        let [said] = said(&mut run.0, ["dashboard at http://"]);
        let (address, token) = said.split_once("/#token=").unwrap();
        Self { address: address.into(), token: token.into(), _run: run, directory }
    }

    fn here(&self) -> &Path {
        self.directory.path()
    }

    fn status(&self) -> Value {
        serde_json::from_str(&succeed(self.here(), ["status", "campaign", "--json"])).unwrap()
    }

    fn job(&self, id: &str) -> Value {
        let shown = succeed(self.here(), ["queue", "campaign", "show", id, "--json"]);
        serde_json::from_str(&shown).unwrap()
    }

    fn act(&self, id: &str, action: &str, headers: &[(&str, &str)], body: &Value) -> (u16, Value) {
        let path = format!("/api/candidates/{id}/{action}");
        let answer = request(&self.address, "POST", &path, headers, &body.to_string());
        (answer.status, answer.json())
    }
}

/// Pauses or resumes a walk. Returns status and body of the response.
fn change_walk(live: &Live, path: &str, headers: &[(&str, &str)]) -> (u16, Value) {
    let answer = request(&live.address, "POST", &format!("/api/walks/{path}"), headers, "{}");
    (answer.status, answer.json())
}

/// Every line of the table, read in pages of `limit`.
fn all_lines(address: &str, query: &str, limit: usize) -> Vec<Value> {
    let (mut lines, mut after) = (Vec::new(), String::new());
    loop {
        let page = get(address, &format!("/api/candidates?limit={limit}&{query}{after}"));
        assert_eq!(page.status, 200, "{page:?}");
        let page = page.json();
        let found = page["candidates"].as_array().unwrap();
        assert!(found.len() <= limit);
        lines.extend(found.iter().cloned());
        let Some(next) = page["next"].as_str() else { return lines };
        after = format!("&after={next}");
    }
}

fn check_pages(address: &str) {
    let index = get(address, "/");
    assert_eq!(index.status, 200);
    let wanted = "content-security-policy: default-src 'none'; script-src 'self'";
    assert!(
        index.head.contains(wanted) && index.head.contains("x-content-type-options: nosniff"),
        "{}",
        index.head
    );
    for file in index.body.split('"').filter(|word| word.starts_with("/pages/")) {
        let file = get(address, file);
        assert!(file.status == 200 && file.head.contains("content-security-policy"), "{}", file.head);
    }
    assert_eq!(get(address, "/pages/../Cargo.toml").status, 404);
    assert_eq!(get(address, "/pages/none.js").status, 404);
    let rebound = request(address, "GET", "/api/samples", &[("Host", "rebound.example:80")], "");
    assert_eq!((rebound.status, rebound.body.contains("time")), (403, false));
    assert_eq!(request(address, "GET", "/api/samples", &[("Host", "localhost:9999")], "").status, 200);
}

fn check_table(live: &Live) {
    let address = &live.address;
    let status = live.status();
    let count = |pointer: &str| status.pointer(pointer).unwrap().as_u64().unwrap() as usize;
    let all = all_lines(address, "", 3);
    assert_eq!(all.len(), count("/candidates/seen") + count("/candidates/control"));
    let names: BTreeSet<_> = all.iter().map(|line| line["id"].as_str().unwrap()).collect();
    assert_eq!(names.len(), all.len());
    let column =
        |lines: &[Value], key: &str| lines.iter().map(|line| line[key].as_f64().unwrap()).collect::<Vec<_>>();
    let mut ascending = all_lines(address, "ascending=true", 7);
    ascending.reverse();
    assert_eq!(ascending, all);
    for (order, key) in [("gamma", "gamma"), ("relative_volume", "relative_volume")] {
        let falling = column(&all_lines(address, &format!("order={order}"), 2), key);
        assert!(falling.len() == all.len() && falling.is_sorted_by(|a, b| a >= b), "{falling:?}");
        let rising = column(&all_lines(address, &format!("order={order}&ascending=true"), 5), key);
        assert!(rising.len() == all.len() && rising.is_sorted(), "{rising:?}");
    }
    for fate in ["accepted", "covered", "duplicate", "too_close", "budget", "control"] {
        let wanted = |line: &&Value| match line["origin"].as_str() {
            Some("control") => fate == "control",
            _ => line["fate"] == fate,
        };
        let expected: Vec<_> = all.iter().filter(wanted).cloned().collect();
        assert_eq!(all_lines(address, &format!("fate={fate}"), 2), expected, "{fate}");
        assert_eq!(
            all_lines(address, &format!("fate={fate}&order=gamma"), 2).len(),
            expected.len(),
            "{fate}"
        );
    }
    let queue = all_lines(address, "order=queue&state=queued", 2);
    let shown =
        succeed(live.here(), ["queue", "campaign", "list", "--state", "queued", "--limit", "1000", "--json"]);
    let listed: Vec<Value> = serde_json::from_str(&shown).unwrap();
    let page = get(address, "/api/candidates?order=queue&state=queued").json();
    assert_eq!(page["imported"], 0);
    let names = |lines: &[Value], key: &str| lines.iter().map(|line| line[key].clone()).collect::<Vec<_>>();
    assert_eq!(names(&queue, "id"), names(&listed, "candidate"));
    let found = all_lines(address, "where=gamma+%3E+1.1+and+element+%3D+Al+and+origin+%3D+biased", 4);
    let expected = |line: &&Value| line["gamma"].as_f64() > Some(1.1) && line["origin"] == "biased";
    assert_eq!(found, all.iter().filter(expected).cloned().collect::<Vec<_>>());
    assert_eq!(all_lines(address, "where=energy+%3C+1", 4), Vec::<Value>::new(), "there is no label");
    for fate in ["", "&fate=accepted"] {
        let found = all_lines(address, &format!("where=walk+%3D+0+and+gamma+%3E+1{fate}"), 2);
        let expected = all.iter().filter(|line| {
            line["walk"] == 0
                && line["gamma"].as_f64() > Some(1.0)
                && (fate.is_empty() || line["fate"] == "accepted")
        });
        assert!(found.len() > 1 && found.iter().eq(expected), "{fate}: {}", found.len());
    }
    // Candidates of a state, and those within limits, are found otherwise than all.
    for query in ["", "&ascending=true", "&order=gamma", "&order=relative_volume&ascending=true"] {
        let all = all_lines(address, query, 50);
        let of_state: Vec<_> = all.iter().filter(|line| line["job_state"] == "queued").cloned().collect();
        assert!(of_state.len() > 2, "{}", of_state.len());
        assert_eq!(all_lines(address, &format!("state=queued{query}"), 2), of_state, "{query}");
        let within = |line: &&Value| {
            line["gamma"].as_f64() > Some(1.1) && line["relative_volume"].as_f64() < Some(2.0)
        };
        let within: Vec<_> = all.iter().filter(within).cloned().collect();
        let limits = format!("where=gamma+%3E+1.1+and+relative_volume+%3C+2{query}");
        assert_eq!(all_lines(address, &limits, 2), within, "{query}");
        let covered: Vec<_> = within.into_iter().filter(|line| line["fate"] == "covered").collect();
        assert_eq!(all_lines(address, &format!("{limits}&fate=covered"), 3), covered, "{query}");
    }
    for nothing in ["state=failed", "state=queued&fate=covered", "where=gamma+%3E+1e9"] {
        assert_eq!(all_lines(address, nothing, 9), Vec::<Value>::new(), "{nothing}");
    }
    let file = get(address, "/api/candidates.extxyz?state=queued&ascending=true");
    let frames: Vec<_> = ExtxyzReader::new(file.body.as_bytes()).map(|frame| frame.unwrap()).collect();
    let waiting = all_lines(address, "state=queued&ascending=true", 50);
    let names_of = frames.iter().map(|frame| frame.info["candidate_id"].text().unwrap());
    assert!(names_of.eq(waiting.iter().map(|line| line["id"].as_str().unwrap())), "{}", file.head);
    assert!(frames.len() > 2 && frames.iter().all(|frame| !frame.info.contains_key("energy")));
    let wrong = get(address, "/api/candidates?where=gama+%3E+1");
    assert!(
        wrong.status == 400 && wrong.json()["error"].as_str().unwrap().contains("gamma_nbr"),
        "{wrong:?}"
    );
}

fn check_candidate(live: &Live, id: &str) {
    let details = get(&live.address, &format!("/api/candidates/{id}")).json();
    let explained = succeed(live.here(), ["explain", "campaign", id, "--json"]);
    let mut explained: Value = serde_json::from_str(&explained).unwrap();
    // It is computed from all labels, which is too slow for a page.
    assert!(explained.as_object_mut().unwrap().remove("expected_errors").is_some());
    assert!(details == explained, "{id}");
    let shown = get(&live.address, &format!("/api/candidates/{id}/structure")).json();
    let file = get(&live.address, &format!("/api/candidates/{id}/structure.extxyz"));
    assert!(file.head.contains(&format!("attachment; filename=\"{id}.extxyz\"")), "{}", file.head);
    let frame = ExtxyzReader::new(file.body.as_bytes()).next().unwrap().unwrap();
    assert_eq!(shown["positions"], json!(frame.structure.positions));
    assert_eq!(shown["cell"], json!(frame.structure.cell.0));
    let gamma = frame.arrays["gamma"].reals().unwrap();
    let largest = gamma.iter().copied().fold(0.0, f64::max);
    assert_eq!(details["grades"]["original"]["gamma_max"], largest);
    let poscar = get(&live.address, &format!("/api/candidates/{id}/structure.poscar"));
    assert_eq!(read_poscar(poscar.body.as_bytes()).unwrap().structure.len(), gamma.len());
    let walk = details["found"]["walk"].as_u64().unwrap();
    let trace = get(&live.address, &format!("/api/walks/{walk}/candidates")).json();
    assert!(trace.as_array().unwrap().iter().any(|line| line["id"] == id), "{trace}");
    let unknown = get(&live.address, "/api/candidates/nobody");
    assert!(unknown.status == 404 && unknown.body.contains("nobody"), "{unknown:?}");
}

fn check_actions(live: &Live, id: &str) {
    let token = ("x-calmwalk-token", live.token.as_str());
    let origin = format!("http://{}", live.address);
    let before = live.job(id);
    let priority = json!({ "priority": 99 });
    let wrong = "0".repeat(live.token.len());
    for (status, headers) in [
        (401, vec![]),
        (401, vec![("x-calmwalk-token", wrong.as_str())]),
        (401, vec![("x-calmwalk-token", &live.token[1..])]),
        (403, vec![token, ("Origin", "http://example.org")]),
        (403, vec![token, ("Origin", "null")]),
        (403, vec![token, ("Sec-Fetch-Site", "cross-site")]),
        (403, vec![token, ("Sec-Fetch-Site", "same-site")]),
    ] {
        let (found, why) = live.act(id, "prioritise", &headers, &priority);
        assert_eq!(found, status, "{headers:?} {why}");
    }
    let path = format!("/api/candidates/{id}/drop");
    let rebound = request(&live.address, "POST", &path, &[token, ("Host", "rebound.example")], "{}");
    assert_eq!(rebound.status, 403);
    assert_eq!(get(&live.address, &path).status, 405);
    let asked = request(&live.address, "OPTIONS", &path, &[("Origin", "http://example.org")], "");
    assert!(!asked.head.contains("access-control"), "{}", asked.head);
    assert_eq!(live.job(id), before, "no refused request changes anything");

    let headers = [token, ("Origin", origin.as_str()), ("Sec-Fetch-Site", "same-origin")];
    assert_eq!(live.act(id, "prioritise", &headers, &json!({})).0, 400);
    let (status, job) = live.act(id, "prioritise", &headers, &priority);
    assert_eq!((status, &job["priority"]), (200, &json!(99)));
    assert_eq!(live.job(id)["priority"], 99);
    for (action, state) in [("drop", "dropped"), ("retry", "queued")] {
        let (status, job) = live.act(id, action, &headers, &json!({}));
        assert_eq!((status, &job["state"]), (200, &json!(state)));
        assert_eq!(live.job(id)["state"], state);
    }
    let (status, why) = live.act(id, "retry", &headers, &json!({}));
    assert!(status == 409 && why["error"].as_str().unwrap().contains("queued"), "{why}");
    let allowed = request(&live.address, "GET", "/api/actions", &[token], "").json();
    assert_eq!(allowed, json!({ "possible": true, "token_is_right": true }));
}

#[test]
fn a_live_campaign_is_looked_at_and_changed() {
    let live = Live::begin();
    check_pages(&live.address);
    let news = first_event(&live.address, "/api/events");
    assert_eq!(news["status"]["campaign"], live.status()["campaign"]);
    let samples = get(&live.address, "/api/samples").json();
    assert!(samples[0]["time"].as_i64() > Some(0), "{samples}");
    check_table(&live);
    let queue = all_lines(&live.address, "order=queue&state=queued", 50);
    let id = queue[0]["id"].as_str().unwrap();
    check_candidate(&live, id);
    check_actions(&live, id);
    let token = [("x-calmwalk-token", live.token.as_str())];
    let (status, why) = change_walk(&live, "0/pause", &token);
    assert!(status == 409 && why["error"].as_str().unwrap().contains("walk 0"), "{why}");
    check_mixture(&live);
    check_copy(&live, id);
}

/// Compares the components with the artifact; some have moved.
fn check_mixture(live: &Live) {
    let mixture = get_computed(&live.address, "/api/mixture");
    assert_eq!(mixture["version"], live.status()["mixture_version"]);
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let shown = succeed(live.here(), ["calm", "info", &artifact, "--json"]);
    let artifact: Value = serde_json::from_str(&shown).unwrap();
    let (found, before) =
        (mixture["components"].as_array().unwrap(), artifact["components"].as_array().unwrap());
    assert_eq!(found.len(), before.len());
    for (found, before) in found.iter().zip(before) {
        for (key, of_artifact) in [
            ("element", "element"),
            ("component", "component"),
            ("threshold", "threshold"),
            ("environments_before", "count"),
        ] {
            assert_eq!(found[key], before[of_artifact], "{key}");
        }
        let number = |key: &str| found[key].as_f64().unwrap();
        let has_moved = found["moved"] == true;
        assert_eq!(number("distance") > 0.0, has_moved, "{found}");
        assert_eq!(number("environments") > number("environments_before"), has_moved, "{found}");
        assert_eq!(number("mean_square_growth") != 1.0, has_moved, "{found}");
        assert!(number("shrunk") <= number("grown") && number("condition_number") >= 1.0, "{found}");
    }
    assert!(found.iter().any(|component| component["moved"] == true));
}

/// A condition selects the same candidates in the table as in `calmwalk export`.
#[test]
fn the_table_and_exports_speak_one_language() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    let mut command = program(here);
    command.args(["dashboard", "campaign", "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    let address = address.trim_end_matches('/');
    let labelled = all_lines(address, "state=labelled", 9);
    let number = |line: &Value, key: &str| line[key].as_f64().unwrap();
    let middle = |of: &dyn Fn(&Value) -> f64| {
        let mut found: Vec<_> = labelled.iter().map(of).collect();
        found.sort_by(f64::total_cmp);
        found[found.len() / 2]
    };
    let [energy, force, gamma] =
        ["energy", "max_force", "gamma"].map(|key| middle(&|line| number(line, key)));
    let per_atom = middle(&|line| number(line, "energy") / number(line, "atoms"));
    for condition in [
        format!("max_force > {force}"),
        format!("energy <= {energy} and max_force > 0"),
        format!("energy_per_atom < {per_atom}"),
        format!("not gamma >= {gamma} and mixture_version != 3 and energy < 1e9"),
        format!("gamma > {gamma} and energy < 1e9 or origin = control and energy < 1e9 and step > 100"),
    ] {
        succeed(here, ["export", "campaign", "--output", "set.extxyz", "--control", "--where", &condition]);
        let frames = fs::File::open(here.join("set.extxyz")).unwrap();
        let frames = ExtxyzReader::new(BufReader::new(frames)).map(|frame| frame.unwrap());
        let exported: BTreeSet<_> =
            frames.map(|frame| frame.info["candidate_id"].text().unwrap().to_owned()).collect();
        let query: String = form_urlencoded::byte_serialize(condition.as_bytes()).collect();
        let found = all_lines(address, &format!("where={query}"), 3);
        let found: BTreeSet<_> = found.iter().map(|line| line["id"].as_str().unwrap().to_owned()).collect();
        assert_eq!(found, exported, "{condition}");
        assert!(!found.is_empty() && found.len() < labelled.len(), "{condition}: {}", found.len());
    }
}

#[test]
fn walks_are_paused_and_resumed_with_the_token() {
    // The queue limit blocks the walkers, so the walks never end.
    let live = Live::labelling("concurrency = 0\nqueue_limit = 4");
    wait_until("walkers wait", || live.status()["labels"]["queued"].as_u64() > Some(4));
    let paused = || {
        let status = live.status();
        let walks = status["walks"].as_array().unwrap().iter().filter(|walk| walk["paused"] == true);
        walks.map(|walk| walk["walk"].as_u64().unwrap()).collect::<Vec<_>>()
    };
    let status = live.status();
    let walks = status["walks"].as_array().unwrap().iter();
    let going = walks.filter(|walk| ["waiting", "running"].contains(&walk["state"].as_str().unwrap()));
    let going: Vec<_> = going.map(|walk| walk["walk"].as_u64().unwrap()).collect();
    let pause = format!("{}/pause", going[0]);
    let token = ("x-calmwalk-token", live.token.as_str());
    for (status, headers) in [
        (401, vec![]),
        (403, vec![token, ("Origin", "http://example.org")]),
        (403, vec![token, ("Sec-Fetch-Site", "cross-site")]),
    ] {
        let (found, why) = change_walk(&live, &pause, &headers);
        assert_eq!(found, status, "{headers:?} {why}");
    }
    assert_eq!(get(&live.address, &format!("/api/walks/{pause}")).status, 405);
    assert_eq!(paused(), [0; 0], "no refused request changes anything");

    assert_eq!(change_walk(&live, &pause, &[token]), (200, json!({ "changed": [going[0]], "paused": true })));
    assert_eq!(paused(), [going[0]]);
    assert_eq!(change_walk(&live, &pause, &[token]), (200, json!({ "changed": [], "paused": true })));
    assert_eq!(change_walk(&live, "all/pause", &[token]).1["changed"], json!(going[1..]));
    assert_eq!(paused(), going);
    assert_eq!(change_walk(&live, "all/resume", &[token]).1["changed"], json!(going));
    assert_eq!(paused(), [0; 0]);
    for (path, status) in [("77/pause", 404), ("0/stop", 404), ("first/pause", 400), ("-1/pause", 400)] {
        assert_eq!(change_walk(&live, path, &[token]).0, status, "{path}");
    }
}

/// The dashboard of a copy is read-only.
fn check_copy(live: &Live, id: &str) {
    let here = live.here();
    succeed(here, ["store", "backup", "campaign", "copy"]);
    let mut command = program(here);
    command.args(["dashboard", "copy", "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    let address = address.trim_end_matches('/');
    assert_eq!(all_lines(address, "", 50), all_lines(&live.address, "", 50));
    assert_eq!(get_computed(address, "/api/mixture"), get_computed(&live.address, "/api/mixture"));
    assert_eq!(get(address, "/api/actions").json()["possible"], false);
    let token = [("x-calmwalk-token", live.token.as_str())];
    assert_eq!(request(address, "POST", &format!("/api/candidates/{id}/drop"), &token, "{}").status, 403);
    assert_eq!(request(address, "POST", "/api/walks/0/pause", &token, "{}").status, 403);
    let open = refuse(here, ["dashboard", "copy", "--address", "0.0.0.0:0"]);
    assert!(open.contains("ssh -L"), "{open}");
}
