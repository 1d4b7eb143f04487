//! What must hold of the versions of the potential.

use super::world::World;

/// Questions whose answer is 0, and what it means if not.
const MUST_BE_NONE: [(&str, &str); 5] = [
    ("numbers of versions have gaps", "SELECT coalesce(max(number), 0) - count(*) FROM version"),
    (
        "a refit was recorded twice",
        "SELECT count(*) FROM (SELECT 1 FROM version WHERE state = 'registered' AND method <> 'rollback'
         GROUP BY parent HAVING count(*) > 1)",
    ),
    (
        "versions were taken up that are not registered",
        "SELECT count(*) FROM decision WHERE kind = 'version' AND NOT EXISTS (
            SELECT 1 FROM version WHERE state = 'registered' AND number = json_extract(detail, '$.version')
            AND model_hash = json_extract(detail, '$.model') AND mixture_hash = json_extract(detail, '$.mixture'))",
    ),
    (
        "a version was taken up after a later one",
        "SELECT count(*) FROM decision AS a JOIN decision AS b ON b.kind = 'version' AND b.sequence > a.sequence
         WHERE a.kind = 'version' AND json_extract(b.detail, '$.version') <= json_extract(a.detail, '$.version')",
    ),
    (
        "decisions were made with an earlier version than the one taken up",
        "SELECT count(*) FROM decision AS taken JOIN decision ON decision.sequence > taken.sequence
         JOIN walk_conditions ON walk_conditions.walk = decision.walk
         WHERE taken.kind = 'version' AND coalesce(json_extract(conditions, '$.version'), 0) < json_extract(taken.detail, '$.version')",
    ),
];

impl World {
    /// Checks the versions after a write.
    pub fn check_versions(&mut self) {
        let all = MUST_BE_NONE.map(|(_, question)| format!("({question})")).join(" || ',' || ");
        let trained = "SELECT count(*) FROM version WHERE state = 'registered' AND method <> 'rollback'";
        let (answers, trained): (String, i64) = self.ask(&format!("SELECT {all}, ({trained})"));
        let broken = answers.split(',').zip(MUST_BE_NONE).find(|(count, _)| *count != "0");
        if let Some((count, (what, _))) = broken {
            return self.fail(format!("{what} ({count})"));
        }
        let most = self.scenario.refits.as_ref().map_or(0, |plan| plan.rules().max_versions);
        if trained > most as i64 {
            self.fail(format!("{trained} versions are trained, with a limit of {most}"));
        }
    }

    /// Checks a campaign that is over: no version is left to train.
    pub fn check_refits_at_end(&mut self) {
        let schedule = self.refit_schedule();
        if schedule.is_ok_and(|schedule| schedule.progress.is_refit_left()) {
            self.fail("the campaign has ended, and a version is left to train".to_owned());
        }
    }

    /// The versions without the times that they took, a line each.
    pub fn versions_text(&mut self) -> String {
        let versions = self.store.runtime.block_on(self.store.store.versions()).unwrap();
        let line = |version: &store::VersionRecord| {
            format!(
                "version {} from {}: {} {}, {} structures until decision {}, {} labels, {} {}, {}\n",
                version.number,
                version.parent,
                version.state.name(),
                version.reason,
                version.structures,
                version.last_decision,
                version.labels,
                version.model_hash,
                version.mixture_hash,
                version.figures,
            )
        };
        versions.iter().map(line).collect()
    }
}
