//! The text of a configuration of one's own.

use std::path::Path;

use potentials::{RadiiWindows, ZblWindow, ZblWindows};

use super::label_section::label_section;
use super::one_phase;
use super::own_campaign::OwnCampaign;
use super::suggestion::SuggestedSettings;
use super::written_section::{WrittenKey, WrittenSection, list, path_value};
use super::{CAMPAIGN, SCHEMA_LINE};
use crate::exit_status::CommandError;

/// Steps of a biased walk, as in the paper.
const BIASED_STEPS: u64 = 15_000;

/// What closes the loop, for users who have labelled structures that the potential knows.
const REFIT: &str =
    "# [refit]                       # train the potential from the labels, and continue with it (docs/refit.md)
# replay = [\"train.extxyz\"]     # labelled structures that it knows: its training data, or a sample of them
# after_structures = 50         # train when this many more structures are accepted";

/// The text of the configuration in `directory`.
///
/// # Errors
/// Those of its values: a path that is not UTF-8, a potential of unknown format.
pub fn configuration(
    directory: &Path,
    campaign: &OwnCampaign,
    settings: &SuggestedSettings,
) -> Result<String, CommandError> {
    let [potential, calm, seeds] = file_sections(directory, campaign, settings)?;
    let [walk, group, collect, guard, run] = walk_sections(settings);
    let label = label_section(directory, campaign, &settings.elements)?;
    let sections = [potential, calm, seeds, walk, group, collect, guard, label, run];
    let (body, listed) = match campaign.full {
        true => {
            let template = template();
            let listed = "Every key is listed, but for those of label.method (docs/dft-codes.md). Keys that are commented out show \
                 their defaults,\n# or an example where there is none.";
            (full_text(&template, sections.into()), listed)
        }
        false => {
            let shown = sections.iter().filter(|section| !section.keys.is_empty());
            let mut shown: Vec<_> = shown.map(WrittenSection::text).collect();
            shown.push(REFIT.to_owned());
            (
                shown.join("\n\n"),
                "All other keys have their defaults: docs/configuration.md, or `calmwalk init … --full`.",
            )
        }
    };
    Ok(format!(
        "{SCHEMA_LINE}# Suggested by `calmwalk init` for this model and these seed structures: change what you know better.\n\
         # {listed}\n# Units: Å, eV, fs, K. Paths are relative to this file.\n\n{body}\n"
    ))
}

/// The example campaign with every key, but with the section of refits commented out, as in another campaign.
fn template() -> String {
    let (example, other) = (String::from_utf8_lossy(CAMPAIGN), include_str!("../../../configs/silicon.toml"));
    let cut = |text: &str, begin: &str| -> Option<[String; 3]> {
        let (before, rest) = text.split_once(begin)?;
        let (section, after) = rest.split_once("\n[budget]")?;
        Some([before.to_owned(), format!("{begin}{section}"), format!("\n[budget]{after}")])
    };
    match (cut(&example, "\n[refit]"), cut(other, "\n# [refit]")) {
        (Some([before, _, after]), Some([_, section, _])) => [before, section, after].concat(),
        _ => example.into_owned(),
    }
}

/// The sections that name the model, its mixture, and the seed structures.
fn file_sections(
    directory: &Path,
    campaign: &OwnCampaign,
    settings: &SuggestedSettings,
) -> Result<[WrittenSection; 3], CommandError> {
    let model = path_value(directory, &campaign.model)?;
    let structures = campaign.structures.iter().map(|path| path_value(directory, path));
    let structures = list(structures.collect::<Result<Vec<_>, _>>()?);
    let calm = match &campaign.artifact {
        Some(artifact) => {
            let artifact = path_value(directory, artifact)?;
            let comment = "its CALM mixture, with scatter matrices and counts";
            let additive =
                "forgets nothing; the paper: \"convex\", which suits few seed structures".to_owned();
            let mut keys = vec![WrittenKey::new("artifact", artifact, comment)];
            keys.push(match settings.is_one_phase {
                true => one_phase::update_key(),
                false => WrittenKey::new("covariance_update", "\"additive\"", additive),
            });
            keys
        }
        None => {
            let comment = "the mixture of the model stays as it is: an update needs calm.artifact";
            vec![WrittenKey::new("update", "\"never\"", comment)]
        }
    };
    let mut seeds = vec![WrittenKey::new("files", structures, "every frame is a seed structure")];
    if let Some((atoms, height)) = settings.supercells {
        let (atoms, height) = (atoms.to_string(), format!("{height:?}"));
        let comment = "make supercells of periodic cells with fewer atoms";
        let comment = WrittenKey::with_range(comment, "seed_structures.min_atoms");
        seeds.push(WrittenKey::new("min_atoms", atoms, comment));
        let comment = "Å between opposite faces of periodic cells; else supercells";
        let comment = WrittenKey::with_range(comment, "seed_structures.min_height");
        seeds.push(WrittenKey::new("min_height", height, comment));
    }
    Ok([
        WrittenSection::new("[potential]", vec![WrittenKey::new("model", model, "exported GRACE model")]),
        WrittenSection::new("[calm]", calm),
        WrittenSection::new("[seed_structures]", seeds),
    ])
}

/// The sections of the dynamics and of what is collected.
fn walk_sections(settings: &SuggestedSettings) -> [WrittenSection; 5] {
    let round = "biased walks that advance together, on any machine";
    let round = WrittenKey::new("walks_per_round", settings.walks_per_round.to_string(), round);
    let run = WrittenSection::new("[run]", vec![round]);
    let guard = WrittenSection::new("[guard]", settings.zbl.as_ref().map(zbl_key).into_iter().collect());
    if settings.is_one_phase {
        let [walk, group, collect] = one_phase::walk_sections(settings.walks);
        return [walk, group, collect, guard, run];
    }
    let ranged = |name, key, value: String, comment| {
        WrittenKey::new(name, value, WrittenKey::with_range(comment, key))
    };
    let [cold, ..] = settings.temperatures;
    let walk = vec![
        ranged("temperature", "walk.temperature", format!("{cold:?}"), "K; those of [[walks]] come first"),
        ranged("biased_steps", "walk.biased_steps", BIASED_STEPS.to_string(), "as in the paper"),
        ranged(
            "tau",
            "walk.tau",
            format!("{:?}", settings.tau),
            "strength of the bias; the paper: 2.0, for many elements",
        ),
    ];
    let temperatures = list(settings.temperatures.iter().map(|value| format!("{value:?}")));
    let mut group = vec![
        WrittenKey::new("name", "\"all\"", "one walk for each structure, temperature and volume ramp"),
        ranged("temperatures", "walk.temperature", temperatures, "K"),
    ];
    if !settings.volume_ramps.is_empty() {
        let ramp = |[from, to]: &[f64; 2]| format!("{{ from = {from:?}, to = {to:?} }}");
        let ramps = list(settings.volume_ramps.iter().map(ramp));
        group.push(ranged("volume_ramps", "walk.volume_ramp.to", ramps, "V/V₀"));
    }
    [
        WrittenSection::new("[walk]", walk),
        WrittenSection::new("[[walks]]", group),
        WrittenSection::new("[collect]", collect_keys(settings.counts_atoms)),
        guard,
        run,
    ]
}

/// The paper's rules.
fn collect_keys(counts_atoms: bool) -> Vec<WrittenKey> {
    let (criterion, meaning, target, end) = match counts_atoms {
        true => (
            "{ rule = \"atom_count\", threshold = 1.3, fraction = 0.15, min_atoms = 3 }",
            "collect when max(3, ⌈0.15 N⌉) atoms have γ > 1.3",
            "{ rule = \"atom_count\", threshold = 1.3, fraction = 0.15, min_atoms = 3, target = 1.25 }",
            "update the mixture until fewer remain",
        ),
        false => (
            "{ rule = \"maximum_grade\", threshold = 1.5 }",
            "collect when γ_max > 1.5: a structure has too few atoms to count them",
            "{ rule = \"maximum_grade\", target = 1.25 }",
            "update the mixture until γ_max < 1.25",
        ),
    };
    let limit = |name, value: &str, key: &str, comment: &str| {
        WrittenKey::new(name, value, WrittenKey::with_range(comment, key))
    };
    vec![
        WrittenKey::new("criterion", criterion, meaning),
        WrittenKey::new("update_target", target, end),
        limit("max_per_walk", "2", "collect.max_per_walk", "structures of one walk, at most"),
        limit(
            "max_per_seed_structure",
            "6",
            "collect.max_per_seed_structure",
            "structures of all walks of a seed structure, at most",
        ),
    ]
}

/// The key of these windows.
fn zbl_key(windows: &ZblWindows) -> WrittenKey {
    let unit = match windows {
        ZblWindows::PerPair(_) => {
            "ZBL repulsion: full below inner, zero above outer; × sum of covalent radii, pairs in Å"
        }
        ZblWindows::Uniform(_) => "Å; ZBL repulsion: full below inner, zero above outer",
    };
    WrittenKey::new("zbl", zbl_value(windows), unit)
}

fn zbl_value(windows: &ZblWindows) -> String {
    let limits = |ZblWindow { inner, outer }: &ZblWindow| format!("inner = {inner:?}, outer = {outer:?}");
    match windows {
        ZblWindows::Uniform(window) => format!("{{ rule = \"uniform\", {} }}", limits(window)),
        ZblWindows::PerPair(RadiiWindows { inner, outer, pairs }) => {
            let by_radii = limits(&ZblWindow { inner: *inner, outer: *outer });
            let single = pairs.iter().map(|(pair, window)| format!("\"{pair}\" = {{ {} }}", limits(window)));
            let single = single.collect::<Vec<_>>().join(", ");
            let single = if single.is_empty() { single } else { format!(", pairs = {{ {single} }}") };
            format!("{{ rule = \"per_pair\", {by_radii}{single} }}")
        }
    }
}

/// The template with these keys in place of its own; its other keys are commented out.
fn full_text(template: &str, mut sections: Vec<WrittenSection>) -> String {
    // The names of the demo's files are examples.
    let template = template.replace("data/al_eam_1l/", "").replace("data/si_sw_1l/", "").replace("data/", "");
    let template = template.replace("seed_frames.extxyz", "training_frames.extxyz");
    let template = template.replace("schema=aluminium", "schema=campaign");
    let mut take = |is_wanted: &dyn Fn(&str) -> bool| {
        let position = sections.iter().position(|section| is_wanted(&section.header))?;
        Some(sections.remove(position))
    };
    let mut text = Vec::new();
    for block in template.trim_end().split("\n\n").skip_while(|block| !block.starts_with('[')) {
        let header = block.split_inclusive(']').next().unwrap_or_default();
        text.push(match take(&|name| name == header) {
            Some(section) => filled(block, section.keys),
            None => filled(block, Vec::new()),
        });
        // Tables of their own stand behind the section, and behind the example of a group of walks.
        let behind = match header {
            "# [[walks]" => take(&|name| name == "[[walks]]"),
            "[label]" => take(&|name| name.starts_with("[label.")),
            _ => None,
        };
        text.extend(behind.map(|section| section.text()));
    }
    text.join("\n\n")
}

/// A section of the template with these keys instead of its own.
fn filled(block: &str, mut keys: Vec<WrittenKey>) -> String {
    let (mut lines, mut is_replaced) = (Vec::new(), false);
    for line in block.lines() {
        // The comment of the line above continues.
        if line.starts_with("   ") {
            if !is_replaced {
                lines.push(line.to_owned());
            }
            continue;
        }
        let name = line.strip_prefix("# ").unwrap_or(line).split_once(" = ").map(|(name, _)| name);
        let position = name.and_then(|name| keys.iter().position(|key| key.name == name));
        is_replaced = position.is_some();
        let is_in_force = name.is_some() && !line.starts_with(['#', '[']);
        lines.push(match position {
            Some(position) => keys.remove(position).line(),
            None if is_in_force => format!("# {line}"),
            None => line.to_owned(),
        });
    }
    lines.extend(keys.iter().map(WrittenKey::line));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use atoms::ElementPair;

    use super::*;

    #[test]
    fn keys_replace_those_of_the_template_with_their_comments() {
        let block =
            "[a]\nx = 1   # old\n         # more\n# y = 2  # default\ny = 3\n# z = 4\n         # kept";
        let keys = vec![WrittenKey::new("x", "7", "new"), WrittenKey::new("w", "8", "added")];
        let text = filled(block, keys);
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[1], format!("{:<31}   # new", "x = 7"));
        assert_eq!(&lines[2..6], ["# y = 2  # default", "# y = 3", "# z = 4", "         # kept"]);
        assert_eq!((lines[6].starts_with("w = 8 "), lines.len()), (true, 7));
    }

    #[test]
    fn windows_are_written_as_they_are_read() {
        let pair = ElementPair::try_from("H-O".to_owned()).unwrap();
        let pairs = [(pair, ZblWindow { inner: 0.4, outer: 0.6 })];
        for windows in [
            ZblWindows::Uniform(ZblWindow { inner: 1.0, outer: 2.25 }),
            ZblWindows::PerPair(RadiiWindows::default()),
            ZblWindows::PerPair(RadiiWindows { pairs: pairs.into(), ..RadiiWindows::default() }),
        ] {
            let table: toml::Table = format!("zbl = {}", zbl_value(&windows)).parse().unwrap();
            assert_eq!(table["zbl"].clone().try_into::<ZblWindows>().unwrap(), windows);
        }
    }
}
