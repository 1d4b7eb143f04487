//! The setfl file of the embedded-atom method, in both styles.
//!
//! Three comment lines; the elements; `nrho drho nr dr cutoff`; then for each element a line `atomic-number
//! mass lattice-constant lattice`, its embedding energy F(ρ) and its densities ρ(r); then r φ(r) for each pair
//! of elements (1,1), (2,1), (2,2), (3,1), … Source: M. S. Daw, S. M. Foiles, M. I. Baskes, Mater. Sci. Rep. 9,
//! 251 (1993), and the description of `pair_style eam/alloy` and `eam/fs` in the LAMMPS manual.

use std::path::Path;

use atoms::Species;

use crate::potential_file::{Lines, PotentialFile, PotentialFileError};

/// Which densities a setfl file has. For a single element both styles agree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EamStyle {
    /// `eam/alloy`: one density per element, independent of the atom it acts on.
    Alloy,
    /// `eam/fs` (Finnis–Sinclair): one density per ordered pair of elements.
    FinnisSinclair,
}

/// Minimum number of points of a table: the interpolation uses five-point differences.
const MIN_POINTS: usize = 5;

/// The tables of a setfl file.
#[derive(Debug)]
pub(crate) struct Setfl {
    /// The elements, in the order of the file.
    pub(crate) species: Vec<Species>,
    /// Spacing of ρ in the embedding tables.
    pub(crate) density_spacing: f64,
    /// Spacing of r in the other tables, Å.
    pub(crate) distance_spacing: f64,
    /// Cutoff, Å.
    pub(crate) cutoff: f64,
    /// F(ρ), eV, of each element; point k at ρ = k `density_spacing`.
    pub(crate) embedding: Vec<Vec<f64>>,
    /// ρ(r) of the element `source` on an atom of the element `host` at `[source][host]`
    /// (Finnis–Sinclair), or at `[source][0]` for any host (alloy); point k at r = k `distance_spacing`.
    pub(crate) density: Vec<Vec<Vec<f64>>>,
    /// r φ(r), eV Å, at `[a][b]` for b ≤ a; grid as for the density.
    pub(crate) pair: Vec<Vec<Vec<f64>>>,
}

impl Setfl {
    /// Reads the file.
    pub(crate) fn read(path: &Path, style: EamStyle) -> Result<Self, PotentialFileError> {
        let file = PotentialFile::open(path)?;
        let mut lines = file.lines();
        for _ in 0..3 {
            lines.require("three lines of comment")?;
        }
        let species = read_elements(&mut lines)?;
        let grid = Grid::read(&mut lines)?;
        let mut embedding = Vec::new();
        let mut density = Vec::new();
        for element in &species {
            read_element_line(&mut lines, *element, style)?;
            embedding.push(lines.values(grid.densities, &format!("the embedding energy F(ρ) of {element}"))?);
            let hosts = if style == EamStyle::FinnisSinclair { species.len() } else { 1 };
            let what = format!("the density ρ(r) of {element}");
            density.push(read_tables(&mut lines, hosts, grid.distances, &what)?);
        }
        let mut pair = Vec::new();
        for (a, element) in species.iter().enumerate() {
            let what = format!("the pair energy r φ(r) of {element}");
            pair.push(read_tables(&mut lines, a + 1, grid.distances, &what)?);
        }
        reject_trailing(&mut lines)?;
        Ok(Self {
            species,
            density_spacing: grid.density_spacing,
            distance_spacing: grid.distance_spacing,
            cutoff: grid.cutoff,
            embedding,
            density,
            pair,
        })
    }
}

/// `number-of-elements symbol symbol …`
fn read_elements(lines: &mut Lines<'_>) -> Result<Vec<Species>, PotentialFileError> {
    let what = "the number of elements and the symbol of each";
    let line = lines.require(what)?;
    let mut tokens = line.split_whitespace();
    let count = tokens.next().and_then(|token| token.parse::<usize>().ok());
    let mut species: Vec<Species> = Vec::new();
    for token in tokens {
        let element =
            token.parse().map_err(|_| lines.error(format!("'{token}'"), "the symbol of an element"))?;
        if species.contains(&element) {
            return Err(lines.error(format!("{element} twice"), "each element once"));
        }
        species.push(element);
    }
    if species.is_empty() || count != Some(species.len()) {
        return Err(lines.error(format!("'{}'", line.trim()), what));
    }
    Ok(species)
}

/// The line `nrho drho nr dr cutoff`.
struct Grid {
    densities: usize,
    density_spacing: f64,
    distances: usize,
    distance_spacing: f64,
    cutoff: f64,
}

impl Grid {
    fn read(lines: &mut Lines<'_>) -> Result<Self, PotentialFileError> {
        let line = lines.require("'nrho drho nr dr cutoff'")?;
        let tokens: Vec<&str> = line.split_whitespace().collect();
        let points = |index: usize, what: &str| {
            let expected = format!("{what}, a whole number of at least {MIN_POINTS}");
            let token = tokens.get(index).copied().unwrap_or("the end of the line");
            match token.parse::<usize>() {
                Ok(count) if count >= MIN_POINTS => Ok(count),
                _ => Err(lines.error(format!("'{token}'"), expected)),
            }
        };
        let length = |index: usize, what: &str| {
            let value = lines.number_at(&tokens, index, what)?;
            if value > 0.0 { Ok(value) } else { Err(lines.error(value.to_string(), what)) }
        };
        let grid = Self {
            densities: points(0, "nrho, the number of points of F(ρ)")?,
            density_spacing: length(1, "drho, a positive spacing of ρ")?,
            distances: points(2, "nr, the number of points of ρ(r) and r φ(r)")?,
            distance_spacing: length(3, "dr, a positive spacing of r in Å")?,
            cutoff: length(4, "a positive cutoff in Å")?,
        };
        // Files define the cutoff as nr dr or (nr − 1) dr and round it; anything beyond is a mistake.
        let reach = grid.distances as f64 * grid.distance_spacing;
        if grid.cutoff > reach * (1.0 + 1e-6) {
            let expected = format!("at most nr dr = {reach} Å");
            return Err(lines.error(format!("a cutoff of {} Å", grid.cutoff), expected));
        }
        Ok(grid)
    }
}

/// `atomic-number mass lattice-constant lattice`: numbers that the potential does not use.
fn read_element_line(
    lines: &mut Lines<'_>,
    element: Species,
    style: EamStyle,
) -> Result<(), PotentialFileError> {
    let what = format!("the line 'atomic-number mass …' of {element} (the file is read as {style:?})");
    let line = lines.require(&what)?;
    let tokens: Vec<&str> = line.split_whitespace().collect();
    let whole = tokens.first().is_some_and(|token| token.parse::<u32>().is_ok());
    if !whole {
        return Err(lines.error(format!("'{}'", line.trim()), what));
    }
    lines.number_at(&tokens, 1, &what).map(|_| ())
}

fn read_tables(
    lines: &mut Lines<'_>,
    tables: usize,
    points: usize,
    what: &str,
) -> Result<Vec<Vec<f64>>, PotentialFileError> {
    (0..tables).map(|_| lines.values(points, what)).collect()
}

/// Values after the last table mean that the counts in the header are wrong.
fn reject_trailing(lines: &mut Lines<'_>) -> Result<(), PotentialFileError> {
    while let Some(line) = lines.next() {
        if !line.trim().is_empty() {
            return Err(lines.error(format!("'{}'", line.trim()), "the end of the file"));
        }
    }
    Ok(())
}
