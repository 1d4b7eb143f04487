//! The header of a pseudopotential file in the format UPF.

use atoms::Species;

/// Kinds of pseudopotentials: norm-conserving, semilocal, ultrasoft, PAW.
const KINDS: [&str; 5] = ["NC", "SL", "US", "USPP", "PAW"];

/// What the header of a UPF file states.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct UpfHeader {
    element: String,
    kind: String,
    functional: String,
    valence: f64,
    /// Whether it contains spin–orbit coupling.
    fully_relativistic: bool,
}

impl UpfHeader {
    /// Reads the header, or says what is wrong with the file.
    pub fn read(file: &[u8]) -> Result<Self, String> {
        let text = String::from_utf8_lossy(file);
        let (_, rest) = text.split_once("<PP_HEADER").ok_or("is not a UPF file: it has no <PP_HEADER")?;
        let header = match rest.strip_prefix('>') {
            Some(lines) => Self::of_lines(lines, text.contains("<PP_ADDINFO")),
            // Values may contain '>'.
            None => ["/>", "</PP_HEADER>"]
                .iter()
                .filter_map(|end| rest.find(end))
                .min()
                .and_then(|end| Self::of_attributes(&rest[..end])),
        };
        header.ok_or_else(|| {
            "has an unreadable <PP_HEADER: expected element, type, functional and number of valence electrons".to_owned()
        })
    }

    /// Version 1 has one value a line, with spin–orbit coupling in a section of its own.
    fn of_lines(lines: &str, fully_relativistic: bool) -> Option<Self> {
        let mut lines = lines.trim_start().lines().map(str::trim);
        let (_version, element, kind) = (lines.next()?, lines.next()?, lines.next()?);
        let (_core_correction, functional, valence) = (lines.next()?, lines.next()?, lines.next()?);
        valence.contains("Z valence").then_some(())?;
        Some(Self {
            element: element.split_whitespace().next()?.to_owned(),
            kind: kind.split_whitespace().next()?.to_owned(),
            functional: functional.strip_suffix("Exchange-Correlation functional")?.to_owned(),
            valence: number(valence.split_whitespace().next()?)?,
            fully_relativistic,
        })
    }

    /// Version 2 has attributes, in any order.
    fn of_attributes(attributes: &str) -> Option<Self> {
        let spin_orbit =
            attribute(attributes, "has_so").is_some_and(|value| value.to_lowercase().starts_with('t'));
        let full =
            attribute(attributes, "relativistic").is_some_and(|value| value.eq_ignore_ascii_case("full"));
        Some(Self {
            element: attribute(attributes, "element")?.to_owned(),
            kind: attribute(attributes, "pseudo_type")?.to_owned(),
            functional: attribute(attributes, "functional")?.to_owned(),
            valence: number(attribute(attributes, "z_valence")?)?,
            fully_relativistic: spin_orbit || full,
        })
    }

    /// Number of valence electrons of a pseudopotential for this element and for PBE; otherwise why it cannot be
    /// used.
    pub fn valence_of(&self, species: Species) -> Result<f64, String> {
        let Self { element, kind, functional, valence, fully_relativistic } = self;
        if !element.eq_ignore_ascii_case(species.symbol()) {
            return Err(format!("is for {element}, not for {species}"));
        }
        if !KINDS.contains(&kind.as_str()) {
            return Err(format!("is of type '{kind}', expected one of {}", KINDS.join(", ")));
        }
        if !is_pbe(functional) {
            let words = functional.split_whitespace().collect::<Vec<_>>().join(" ");
            return Err(format!("is for the functional {words}, not for PBE"));
        }
        if *fully_relativistic {
            return Err("is fully relativistic; expected a scalar-relativistic one".to_owned());
        }
        match valence.is_finite() && *valence > 0.0 {
            true => Ok(*valence),
            false => Err(format!("has {valence} valence electrons")),
        }
    }
}

/// Whether a functional is PBE, by its short name or by the names of its parts, in either spelling.
fn is_pbe(functional: &str) -> bool {
    let functional = functional.to_uppercase();
    let words: Vec<&str> =
        functional.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).collect();
    // Version 1 repeats the short name behind the parts.
    let parts = words.strip_suffix(&["PBE"]).filter(|parts| parts.len() == 4).unwrap_or(&words);
    matches!(parts, ["PBE"] | ["SLA", "PW", "PBX" | "PBE", "PBC" | "PBE"])
}

/// `value` of `key="value"` or `key='value'`, without blanks around it.
fn attribute<'a>(attributes: &'a str, key: &str) -> Option<&'a str> {
    let name = format!("{key}=");
    let (at, _) = attributes
        .match_indices(&name)
        .find(|(at, _)| attributes[..*at].chars().next_back().is_some_and(char::is_whitespace))?;
    let rest = &attributes[at + name.len()..];
    let quote = rest.chars().next().filter(|quote| ['"', '\''].contains(quote))?;
    rest[1..].split_once(quote).map(|(value, _)| value.trim())
}

/// A number in Fortran's spelling, whose exponent may begin with D.
fn number(text: &str) -> Option<f64> {
    text.replace(['d', 'D'], "e").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: &str = "<UPF version=\"2.0.1\">\n<PP_INFO>\nby > hand\n</PP_INFO>\n<PP_HEADER\n   \
                          generated='Generated using \"atomic\" code'\n   author=\"ADC <a@b.c>\"\n   element=\" B\"\n   \
                          pseudo_type=\"PAW\"\n   relativistic=\"scalar\"\n   has_so=\"F\"\n   \
                          functional=\" SLA PW PBX PBC\"\n   z_valence=\"3.000000000000E+000\"/>\n";

    const FIRST: &str = "<PP_INFO>\n</PP_INFO>\n<PP_HEADER>\n   0                   Version Number\n  \
                         Rh                   Element\n   US                  Ultrasoft pseudopotential\n    \
                         F                  Nonlinear Core Correction\n \
                         SLA  PW   PBE  PBE     PBE  Exchange-Correlation functional\n    \
                         9.00000000000      Z valence\n";

    fn valence(file: &str, symbol: &str) -> Result<f64, String> {
        UpfHeader::read(file.as_bytes())?.valence_of(symbol.parse().unwrap())
    }

    #[test]
    fn both_versions_say_what_a_file_is() {
        assert_eq!(valence(SECOND, "B"), Ok(3.0));
        assert_eq!(valence(FIRST, "Rh"), Ok(9.0));
        assert_eq!(valence(FIRST, "Ni"), Err("is for Rh, not for Ni".to_owned()));
        for (file, symbol, end) in [(SECOND, "B", "z_valence=\"3.0"), (FIRST, "Rh", "9.00000000000")] {
            for end in 0..file.find(end).unwrap() {
                assert!(valence(&file[..end], symbol).is_err(), "cut at {end}");
            }
        }
    }

    #[test]
    fn what_cannot_be_used_says_why() {
        let wrong = |from: &str, to: &str| {
            let file = SECOND.replace(from, to);
            assert_ne!(file, SECOND);
            valence(&file, "B").unwrap_err()
        };
        assert_eq!(wrong("PW PBX PBC", "PW   PSX  PSC"), "is for the functional SLA PW PSX PSC, not for PBE");
        assert_eq!(wrong(" SLA PW PBX PBC", "PBESOL"), "is for the functional PBESOL, not for PBE");
        assert_eq!(wrong("PAW", "1/r"), "is of type '1/r', expected one of NC, SL, US, USPP, PAW");
        let spinor = "is fully relativistic; expected a scalar-relativistic one";
        assert_eq!(wrong("has_so=\"F\"", "has_so=\"true\""), spinor);
        assert_eq!(wrong("scalar", "full"), spinor);
        assert_eq!(valence(&format!("{FIRST}<PP_ADDINFO>\n"), "Rh").unwrap_err(), spinor);
        assert_eq!(wrong("3.000000000000E+000", "0.0"), "has 0 valence electrons");
        // GTH files have another format; the stress that pw.x calculates with them is wrong.
        let gth = valence("Si GTH-PBE-q4\n 2 2\n 0.44 1 -6.26928833\n", "Si").unwrap_err();
        assert_eq!(gth, "is not a UPF file: it has no <PP_HEADER");
    }

    #[test]
    fn all_spellings_of_pbe_are_known_and_nothing_else() {
        for name in
            ["PBE", "pbe", " SLA PW PBX PBC ", "SLA-PW-PBX-PBC", "sla+pw+pbe+pbe", "SLA PW PBX PBC PBE"]
        {
            assert!(is_pbe(name), "{name}");
        }
        for name in
            ["", "PBESOL", "SLA PW PSX PSC", "SLA PZ NOGX NOGC", "TPSS", "PBE0", "SLA PW RPB PBC", "PBE PBE"]
        {
            assert!(!is_pbe(name), "{name}");
        }
    }
}
