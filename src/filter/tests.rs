use std::sync::LazyLock;

use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use super::*;

fn properties() -> StructureProperties<'static> {
    static SPECIES: [Species; 0] = [];
    static RETRY_ADJUSTMENTS: LazyLock<[String; 2]> =
        LazyLock::new(|| ["more_steps", "other_moments"].map(str::to_owned));
    StructureProperties {
        gamma: Some(2.5),
        step: Some(300),
        origin: "biased",
        seed_structure: Some("fcc 100"),
        retry_adjustments: Some(&*RETRY_ADJUSTMENTS),
        species: &SPECIES,
        ..StructureProperties::default()
    }
}

fn matches(text: &str) -> bool {
    let species: Vec<Species> = ["Mo", "Mo", "C"].map(|symbol| symbol.parse().unwrap()).to_vec();
    text.parse::<StructureFilter>().unwrap().matches(&StructureProperties {
        species: &species,
        energy: Some(-6.0),
        fragments: Some(2),
        ..properties()
    })
}

#[test]
fn filters_are_evaluated() {
    for (text, expected) in [
        ("gamma > 2 and element = Mo", true),
        ("gamma > 2 and element = Al", false),
        ("element != Al", true),
        ("element != C", false),
        ("gamma>=2.5", true),
        ("fragments > 1", true),
        ("fragments = 1", false),
        ("gamma < 2.5 or step = 3e2", true),
        // `and` binds closer than `or`, `not` closest.
        ("atoms = 3 or atoms = 4 and step = 0", true),
        ("(atoms = 3 or atoms = 4) and step = 0", false),
        ("not gamma > 3 and step <= 300", true),
        ("seed_structure = 'fcc 100' AND origin != control", true),
        ("energy_per_atom = -2", true),
        ("energy != -6", false),
        ("retry_adjustment = other_moments", true),
        ("retry_adjustment = more_time", false),
        ("retry_adjustment != more_steps", false),
        // A comparison with a missing property is false.
        ("walk = 0 or walk != 0", false),
        ("not walk = 0", true),
    ] {
        assert_eq!(matches(text), expected, "{text}");
    }
}

#[test]
fn a_filter_may_allow_a_single_walk() {
    for (text, walk) in [
        ("walk = 17", Some(17)),
        ("gamma > 2 and (step < 100 and walk = 3)", Some(3)),
        ("walk = 3 or walk = 3", None),
        ("not walk = 3", None),
        ("walk >= 3", None),
        ("step = 3", None),
        ("walk = 1.5", None),
        ("walk = -1", None),
        ("walk = 1e12", None),
    ] {
        assert_eq!(text.parse::<StructureFilter>().unwrap().only_walk(), walk, "{text}");
    }
}

#[test]
fn limits_of_a_property_follow_from_the_filter() {
    for (text, limits) in [
        ("gamma > 2", [Some(2.0), None]),
        ("gamma = 2", [Some(2.0), Some(2.0)]),
        ("gamma > 2 and gamma <= 5 and step = 3", [Some(2.0), Some(5.0)]),
        ("gamma >= 2 and gamma > 3", [Some(3.0), None]),
        ("gamma > 2 or gamma > 1", [Some(1.0), None]),
        ("gamma = 2 or gamma = 3", [Some(2.0), Some(3.0)]),
        ("gamma > 2 or step = 3", [None, None]),
        ("gamma < 2 or gamma > 3", [None, None]),
        ("not gamma > 2", [None, None]),
        ("gamma != 2", [None, None]),
        ("gamma_nbr > 2", [None, None]),
    ] {
        let filter: StructureFilter = text.parse().unwrap();
        assert_eq!(filter.limits(NumberField::Gamma), limits, "{text}");
    }
}

/// Whether the text contains the word, not as a part of another word.
fn has_word(text: &str, word: &str) -> bool {
    text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').any(|found| found == word)
}

#[test]
fn versions_are_those_of_the_walk() {
    let conditions = WalkConditions { version: 2, ..WalkConditions::default() };
    let found = StructureProperties { conditions: Some(&conditions), ..properties() };
    for (text, expected) in
        [("version = 2", true), ("version < 2", false), ("version != 0 and gamma > 2", true)]
    {
        assert_eq!(text.parse::<StructureFilter>().unwrap().matches(&found), expected, "{text}");
    }
    assert!(!matches("version = 0"), "unknown");
}

#[test]
fn help_and_docs_name_every_property() {
    use clap::CommandFactory;
    let mut command = crate::cli::Arguments::command();
    let export = command.find_subcommand_mut("export").unwrap();
    let filter = export.get_arguments().find(|argument| argument.get_long() == Some("where")).unwrap();
    let help = filter.get_long_help().unwrap().to_string();
    let docs = include_str!("../../docs/export.md").split("## Select structures").nth(1).unwrap();
    let page = include_str!("../web/pages/candidates.js");
    let numbers = NumberField::ALL.iter().map(|(_, name)| *name);
    for name in numbers.chain(TextField::ALL.iter().map(|(_, name)| *name)) {
        for (place, text) in [("help", help.as_str()), ("docs/export.md", docs), ("candidates.js", page)] {
            // The table of the dashboard has no positions.
            let is_unknown = place == "candidates.js" && name == "fragments";
            assert!(has_word(text, name) != is_unknown, "{name} is missing in {place}");
        }
    }
}

#[test]
fn names_are_those_in_the_expression() {
    let condition: StructureFilter = "not (gamma > 2 or element = Mo) and max_force < 5".parse().unwrap();
    assert_eq!(condition.names(), ["gamma", "element", "max_force"]);
}

#[test]
fn errors_have_positions() {
    for (text, position, found, expected) in [
        ("", 1, "the end", "gamma_nbr"),
        ("gama > 2", 1, "'gama'", "one of gamma,"),
        ("gamma 2", 7, "'2'", "one of = != <"),
        ("gamma > Mo", 9, "'Mo'", "a number"),
        ("gamma > inf", 9, "'inf'", "a number"),
        ("gamma > 2 element = Mo", 11, "'element'", "'and', 'or' or the end"),
        ("(gamma > 2", 11, "the end", "')'"),
        ("element > Mo", 9, "'>'", "= or != after element"),
        ("element = Xx", 11, "'Xx'", "the symbol of an element"),
        ("origin = biassed", 10, "'biassed'", "biased, control or imported"),
        ("retry_adjustment = moments", 20, "'moments'", "other_moments"),
        ("seed_structure = 'fcc", 18, "an unterminated text", "a closing '"),
        ("γ > 2", 1, "'γ'", "one of gamma,"),
        ("gamma > 2 && step = 1", 11, "'&'", "a name"),
    ] {
        let error = text.parse::<StructureFilter>().unwrap_err();
        assert_eq!((error.position, error.found.as_str()), (position, found), "{text}");
        assert!(error.expected.contains(expected), "{text}: {error}");
    }
    let deep = "not ".repeat(100_000) + "gamma > 1";
    assert!(deep.parse::<StructureFilter>().unwrap_err().expected.contains("at most 100"));
}

fn conditions() -> impl Strategy<Value = StructureFilter> {
    use ComparisonOperator::*;
    let number =
        proptest::sample::select(NumberField::ALL.iter().map(|(field, _)| *field).collect::<Vec<_>>());
    let comparison = proptest::sample::select(vec![Equal, Different, Below, AtMost, Above, AtLeast]);
    let finite = any::<f64>().prop_filter("finite", |x| x.is_finite());
    let numbers = (number, comparison, finite).prop_map(|(a, b, c)| StructureFilter::Number(a, b, c));
    let seed = ("[a-zé' ()=0-9]{0,12}", any::<bool>())
        .prop_map(|(name, equal)| StructureFilter::Text(TextField::SeedStructure, equal, name));
    let element = proptest::sample::select(vec!["Al", "Mo"]);
    let element =
        element.prop_map(|symbol| StructureFilter::Text(TextField::Element, true, symbol.to_owned()));
    prop_oneof![numbers, seed, element].prop_recursive(5, 40, 2, |inner| {
        let pair = (inner.clone(), inner.clone());
        prop_oneof![
            inner.prop_map(|a| StructureFilter::Not(Box::new(a))),
            pair.clone().prop_map(|(a, b)| StructureFilter::And(Box::new(a), Box::new(b))),
            pair.prop_map(|(a, b)| StructureFilter::Or(Box::new(a), Box::new(b))),
        ]
    })
}

proptest! {
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(6), ..ProptestConfig::default() })]

    #[test]
    fn displayed_filters_parse_back(condition in conditions()) {
        prop_assert_eq!(condition.to_string().parse::<StructureFilter>(), Ok(condition));
    }

    #[test]
    fn any_text_is_a_filter_or_an_error_inside_it(text in "([a-z_]{1,9}|[ ()<>=!'\"γ.0-9-]|and|or|not|gamma > 1){0,12}") {
        if let Err(error) = text.parse::<StructureFilter>() {
            prop_assert!((1..=text.chars().count() + 1).contains(&error.position), "{error}");
        }
    }
}
