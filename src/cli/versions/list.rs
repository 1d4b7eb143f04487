//! `calmwalk versions … list`

use std::io::{self, Write};

use serde_json::{Value, json};
use store::{Location, VersionRecord, VersionState};

use super::errors::{RecordedErrors, errors_of};
use super::{CommandError, ExitStatus, KnownVersions};
use crate::output::{TextTable, decimals, print, print_json};
use crate::wording::cost::wall_time;
use crate::wording::date;

/// How version 0 was made.
const CONFIGURATION: &str = "configuration";
const TITLES: [&str; 10] = [
    ">version",
    "state",
    ">parent",
    "method",
    ">labels",
    ">wall time",
    ">core-hours",
    "date",
    ">held out (eV/Å)",
    ">replay (eV/Å)",
];

/// Lists the versions.
pub fn run(location: &Location, json: bool) -> Result<ExitStatus, CommandError> {
    let known = super::read(location, async |store| KnownVersions::read(store).await)?;
    if json {
        print_json(&to_json(&known))?;
    } else {
        print(|out| write(out, &known))?;
    }
    Ok(ExitStatus::Done)
}

/// Mean absolute errors of the forces of a version, eV/Å: on labels held out, and on the replay data.
fn force_errors(known: &KnownVersions, number: u32) -> [Option<f64>; 2] {
    let errors = errors_of(&known.versions, number);
    ["held_out", "replay"]
        .map(|kind| errors.iter().find(|found| found.kind == kind).and_then(RecordedErrors::force_mae))
}

fn write(out: &mut dyn Write, known: &KnownVersions) -> io::Result<()> {
    let mut table = TextTable::new(&TITLES);
    let none = || "–".to_owned();
    let mut push = |number: u32, columns: [String; 6]| {
        let mut row = vec![number.to_string(), known.state(number)];
        row.extend(columns);
        row.extend(force_errors(known, number).map(|error| decimals(error, 4)));
        table.push(row);
    };
    push(0, [none(), CONFIGURATION.to_owned(), none(), none(), none(), none()]);
    for version in &known.versions {
        let VersionRecord { number, parent, method, labels, seconds, core_hours, time, .. } = version;
        let columns = [
            parent.to_string(),
            method.clone(),
            labels.to_string(),
            wall_time(*seconds),
            format!("{core_hours:.2}"),
            date::utc(*time),
        ];
        push(*number, columns);
    }
    table.write(out)?;
    for version in known.versions.iter().filter(|version| version.state == VersionState::Refused) {
        writeln!(out, "version {} was refused: {}", version.number, version.reason)?;
    }
    match known.not_taken_up() {
        Some(number) => writeln!(
            out,
            "no walk uses version {number} yet: calmwalk run switches to it, unless the campaign ends with it"
        ),
        None => Ok(()),
    }
}

fn to_json(known: &KnownVersions) -> Value {
    let mut versions = vec![first_to_json()];
    versions.extend(known.versions.iter().map(record_to_json));
    for (number, version) in (0..).zip(&mut versions) {
        let [held_out, replay] = force_errors(known, number);
        version["in_force"] = json!(number == known.taken_up);
        version["force_mae"] = json!({ "held_out": held_out, "replay": replay });
    }
    json!({ "in_force": known.taken_up, "not_taken_up": known.not_taken_up(), "versions": versions })
}

/// Version 0 as JSON, with the keys of [`record_to_json`].
pub fn first_to_json() -> Value {
    json!({
        "number": 0, "state": VersionState::Registered, "method": CONFIGURATION, "parent": null, "reason": "",
        "structures": 0, "last_decision": 0, "labels": 0, "model_hash": null, "mixture_hash": null, "seconds": null,
        "core_hours": null, "time": null,
    })
}

/// A version without its figures as JSON.
pub fn record_to_json(version: &VersionRecord) -> Value {
    json!({
        "number": version.number, "state": version.state, "method": version.method, "parent": version.parent,
        "reason": version.reason, "structures": version.structures, "last_decision": version.last_decision,
        "labels": version.labels, "model_hash": version.model_hash, "mixture_hash": version.mixture_hash,
        "seconds": version.seconds, "core_hours": version.core_hours, "time": version.time,
    })
}
