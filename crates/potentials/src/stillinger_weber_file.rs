//! The parameter file of the Stillinger–Weber potential.
//!
//! Entries of fourteen words, over one or more lines: `element₁ element₂ element₃ ε σ a λ γ cosθ₀ A B p q tol`;
//! `#` starts a comment. Each ordered triplet of the elements has one entry. Source: the description of
//! `pair_style sw` in the LAMMPS manual.

use std::path::Path;

use atoms::Species;

use crate::potential_file::{Lines, PotentialFile, PotentialFileError};

/// The parameters of one entry, in the order of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Parameters {
    /// ε, eV.
    pub(crate) epsilon: f64,
    /// σ, Å.
    pub(crate) sigma: f64,
    /// a: the range of the pair is a σ.
    pub(crate) a: f64,
    /// λ, strength of the three-body energy.
    pub(crate) lambda: f64,
    /// γ, its decay.
    pub(crate) gamma: f64,
    /// cos θ₀ of the ideal angle.
    pub(crate) cosine: f64,
    /// A, strength of the two-body energy.
    pub(crate) big_a: f64,
    /// B, relative strength of the repulsion.
    pub(crate) big_b: f64,
    /// p, exponent of the repulsion.
    pub(crate) p: f64,
    /// q, exponent of the attraction.
    pub(crate) q: f64,
    /// The value of the exponentials below which the pair is neglected; 0: never.
    pub(crate) tolerance: f64,
}

impl Parameters {
    /// The range of the pair, Å: a σ, or where exp(min(γ, 1) σ / (r − aσ)) equals the tolerance.
    ///
    /// This is the manual's virtual cutoff; a tolerance above 0.01 counts as 0.01.
    pub(crate) fn reach(&self) -> f64 {
        let end = self.a * self.sigma;
        if self.tolerance > 0.0 {
            (end + self.gamma.min(1.0) * self.sigma / self.tolerance.min(0.01).ln()).max(0.0)
        } else {
            end
        }
    }
}

/// The entries of a file.
#[derive(Debug)]
pub(crate) struct StillingerWeberEntries {
    /// All elements of the file, in order of appearance.
    pub(crate) species: Vec<Species>,
    /// `[(i * elements + j) * elements + k]`, i the centre.
    pub(crate) parameters: Vec<Parameters>,
}

struct TripletEntry {
    line: usize,
    triplet: [Species; 3],
    parameters: Parameters,
}

const ENTRY_WORDS: usize = 14;
const ENTRY: &str = "element1 element2 element3 epsilon sigma a lambda gamma costheta0 A B p q tol";

impl StillingerWeberEntries {
    /// Reads the file.
    pub(crate) fn read(path: &Path) -> Result<Self, PotentialFileError> {
        let file = PotentialFile::open(path)?;
        let mut lines = file.lines();
        let mut entries: Vec<TripletEntry> = Vec::new();
        while let Some(entry) = read_entry(&mut lines)? {
            if let Some(first) = entries.iter().find(|other| other.triplet == entry.triplet) {
                let found = format!("a second entry for {:?}", entry.triplet);
                let expected = format!("the one of line {} only", first.line);
                return Err(lines.error_at(entry.line, found, expected));
            }
            entries.push(entry);
        }
        let mut species: Vec<Species> = Vec::new();
        for element in entries.iter().flat_map(|entry| entry.triplet) {
            if !species.contains(&element) {
                species.push(element);
            }
        }
        if species.is_empty() {
            return Err(lines.error("no entry", format!("'{ENTRY}'")));
        }
        check_symmetry(&lines, &entries)?;
        let parameters = in_order(&lines, &species, &entries)?;
        Ok(Self { species, parameters })
    }
}

/// The next fourteen words outside comments; `None` at the end of the file.
fn read_entry(lines: &mut Lines<'_>) -> Result<Option<TripletEntry>, PotentialFileError> {
    let mut words: Vec<&str> = Vec::new();
    let mut first_line = 0;
    while words.len() < ENTRY_WORDS {
        let Some(line) = lines.next() else {
            if words.is_empty() {
                return Ok(None);
            }
            let found = format!("the end of the file after {} of {ENTRY_WORDS} words", words.len());
            return Err(lines.error(found, format!("'{ENTRY}'")));
        };
        if words.is_empty() {
            first_line = lines.number();
        }
        words.extend(line.split('#').next().unwrap_or_default().split_whitespace());
    }
    if words.len() > ENTRY_WORDS {
        return Err(
            lines.error(format!("{} words", words.len()), format!("the {ENTRY_WORDS} words '{ENTRY}'"))
        );
    }
    let element = |index: usize| {
        words[index].parse::<Species>().map_err(|_| {
            lines.error_at(first_line, format!("'{}'", words[index]), "the symbol of an element")
        })
    };
    let triplet = [element(0)?, element(1)?, element(2)?];
    let parameters = read_parameters(lines, &words)?;
    Ok(Some(TripletEntry { line: first_line, triplet, parameters }))
}

fn read_parameters(lines: &Lines<'_>, words: &[&str]) -> Result<Parameters, PotentialFileError> {
    let number = |index, name: &str| lines.number_at(words, index, &format!("a number for {name}"));
    let positive = |index, name: &str| match number(index, name)? {
        value if value >= 0.0 => Ok(value),
        value => Err(lines.error(value.to_string(), format!("{name} of at least 0"))),
    };
    Ok(Parameters {
        epsilon: positive(3, "epsilon")?,
        sigma: positive(4, "sigma")?,
        a: positive(5, "a")?,
        lambda: positive(6, "lambda")?,
        gamma: positive(7, "gamma")?,
        cosine: number(8, "costheta0")?,
        big_a: positive(9, "A")?,
        big_b: positive(10, "B")?,
        p: positive(11, "p")?,
        q: positive(12, "q")?,
        tolerance: positive(13, "tol")?,
    })
}

/// Checks that entries which describe the same pair or angle agree.
///
/// The product λ ε may differ by the rounding of its factors in the file.
fn check_symmetry(lines: &Lines<'_>, entries: &[TripletEntry]) -> Result<(), PotentialFileError> {
    for entry in entries {
        let [i, j, k] = entry.triplet;
        for other in entries {
            if j == k && other.triplet == [j, i, i] && !same_pair(&entry.parameters, &other.parameters) {
                let found = format!("other two-body parameters or another range than in line {}", entry.line);
                return Err(lines.error_at(other.line, found, format!("the same for {i}–{j} and {j}–{i}")));
            }
            if other.triplet == [i, k, j] && !same_angle(&entry.parameters, &other.parameters) {
                let found = format!("another lambda epsilon or costheta0 than in line {}", entry.line);
                let expected = format!("the same for {j}–{i}–{k} and {k}–{i}–{j}");
                return Err(lines.error_at(other.line, found, expected));
            }
        }
    }
    Ok(())
}

fn same_pair(one: &Parameters, other: &Parameters) -> bool {
    let pair = |q: &Parameters| [q.epsilon, q.sigma, q.a, q.big_a, q.big_b, q.p, q.q, q.reach()];
    pair(one) == pair(other)
}

fn same_angle(one: &Parameters, other: &Parameters) -> bool {
    let (first, second) = (one.lambda * one.epsilon, other.lambda * other.epsilon);
    one.cosine == other.cosine && (first - second).abs() <= 1e-6 * first
}

fn in_order(
    lines: &Lines<'_>,
    species: &[Species],
    entries: &[TripletEntry],
) -> Result<Vec<Parameters>, PotentialFileError> {
    let mut parameters = Vec::new();
    for i in species {
        for j in species {
            for k in species {
                let entry = entries.iter().find(|entry| entry.triplet == [*i, *j, *k]);
                let entry = entry.ok_or_else(|| {
                    lines.error(format!("no entry '{i} {j} {k}'"), "one for each triplet of its elements")
                })?;
                parameters.push(entry.parameters);
            }
        }
    }
    Ok(parameters)
}
