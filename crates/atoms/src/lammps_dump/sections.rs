//! The box and the columns of the atoms.

use super::error::DumpErrorKind;
use crate::cell::{Cell, Vec3};
use crate::species::Species;

/// The simulation box.
pub(super) struct SimulationBox {
    /// Its lowest corner, Å.
    origin: Vec3,
    pub cell: Cell,
    pub periodic: [bool; 3],
}

impl SimulationBox {
    /// From the words after `BOX BOUNDS` and the three lines below.
    pub fn parse(words: &str, rows: &[Vec<String>; 3]) -> Result<Self, DumpErrorKind> {
        let words: Vec<&str> = words.split_whitespace().collect();
        let (kind, flags) = words.split_at(words.len().saturating_sub(3));
        let expected = "'pp', 'ff', 'ss' or other boundary flags of three directions after BOX BOUNDS";
        let is_flag = |word: &&str| word.len() == 2 && word.chars().all(|letter| "pfsm".contains(letter));
        if flags.len() != 3 || !flags.iter().all(is_flag) {
            return Err(DumpErrorKind::line(&words.join(" "), expected));
        }
        let periodic = std::array::from_fn(|axis| flags[axis] == "pp");
        let (origin, cell) = match kind {
            [] => orthogonal(&numbers::<2>(rows)?),
            ["xy", "xz", "yz"] => triclinic(&numbers::<3>(rows)?),
            ["abc", "origin"] => general(&numbers::<4>(rows)?),
            _ => {
                let expected =
                    "'xy xz yz', 'abc origin' or nothing between BOX BOUNDS and the boundary flags";
                return Err(DumpErrorKind::line(&words.join(" "), expected));
            }
        };
        // A general cell may have any orientation.
        if kind != ["abc", "origin"] && (0..3).any(|axis| cell[axis][axis] <= 0.0) {
            let rows: Vec<_> = rows.iter().map(|row| row.join(" ")).collect();
            return Err(DumpErrorKind::line(
                &rows.join(", "),
                "lower bounds of the box below the upper ones",
            ));
        }
        Ok(Self { origin, cell: Cell(cell), periodic })
    }

    /// Position from the box's lowest corner, Å. `scaled` coordinates are fractions of the cell vectors.
    pub fn position(&self, x: Vec3, scaled: bool) -> Vec3 {
        if scaled { self.cell.cartesian(x) } else { std::array::from_fn(|axis| x[axis] - self.origin[axis]) }
    }
}

fn orthogonal(bounds: &[[f64; 2]; 3]) -> (Vec3, [Vec3; 3]) {
    let length = |axis: usize| bounds[axis][1] - bounds[axis][0];
    let cell = [[length(0), 0.0, 0.0], [0.0, length(1), 0.0], [0.0, 0.0, length(2)]];
    (bounds.map(|[low, _]| low), cell)
}

/// The bounds of x and y enclose the tilted box.
fn triclinic(bounds: &[[f64; 3]; 3]) -> (Vec3, [Vec3; 3]) {
    let [[x_low, x_high, xy], [y_low, y_high, xz], [z_low, z_high, yz]] = *bounds;
    let tilts = [0.0, xy, xz, xy + xz];
    let (left, right) =
        tilts.iter().fold((0.0, 0.0), |(low, high), tilt| (f64::min(low, *tilt), f64::max(high, *tilt)));
    let origin = [x_low - left, y_low - f64::min(0.0, yz), z_low];
    let [x, y, z] = [x_high - right - origin[0], y_high - f64::max(0.0, yz) - origin[1], z_high - origin[2]];
    (origin, [[x, 0.0, 0.0], [xy, y, 0.0], [xz, yz, z]])
}

fn general(rows: &[[f64; 4]; 3]) -> (Vec3, [Vec3; 3]) {
    (rows.map(|row| row[3]), rows.map(|[x, y, z, _]| [x, y, z]))
}

fn numbers<const N: usize>(rows: &[Vec<String>; 3]) -> Result<[[f64; N]; 3], DumpErrorKind> {
    let mut found = [[0.0; N]; 3];
    for (numbers, words) in found.iter_mut().zip(rows) {
        let parsed: Option<Vec<f64>> = words.iter().map(|word| finite(word)).collect();
        let parsed: Option<[f64; N]> = parsed.and_then(|parsed| parsed.try_into().ok());
        let expected = match N {
            2 => "two finite numbers, the bounds of the box",
            3 => "three finite numbers, the bounds of the box and a tilt factor",
            _ => "four finite numbers, a cell vector and the origin",
        };
        *numbers = parsed.ok_or_else(|| DumpErrorKind::line(&words.join(" "), expected))?;
    }
    Ok(found)
}

fn finite(word: &str) -> Option<f64> {
    word.parse().ok().filter(|number: &f64| number.is_finite())
}

/// An atom of a snapshot.
pub(super) struct DumpAtom {
    /// 0 without the column.
    pub id: i64,
    pub species: Species,
    /// As in the file.
    pub position: Vec3,
}

/// Where the columns are.
pub(super) struct DumpColumns {
    id: Option<usize>,
    species: SpeciesColumn,
    position: [usize; 3],
    scaled: bool,
    count: usize,
}

enum SpeciesColumn {
    Element(usize),
    Type(usize),
}

/// Coordinates, and whether they are fractions of the cell vectors. Unwrapped ones first, so that molecules stay whole.
const COORDINATES: [([&str; 3], bool); 4] = [
    (["xu", "yu", "zu"], false),
    (["x", "y", "z"], false),
    (["xsu", "ysu", "zsu"], true),
    (["xs", "ys", "zs"], true),
];

impl DumpColumns {
    /// From the names after `ATOMS`. A column `element` comes before `types`, which give elements to atom types.
    pub fn parse(names: &str, types: &[Species]) -> Result<Self, DumpErrorKind> {
        let words: Vec<&str> = names.split_whitespace().collect();
        let place = |name: &str| words.iter().position(|word| *word == name);
        let places = |names: [&str; 3]| Some([place(names[0])?, place(names[1])?, place(names[2])?]);
        let found = COORDINATES.iter().find_map(|(names, scaled)| Some((places(*names)?, *scaled)));
        let (position, scaled) = found.ok_or_else(|| DumpErrorKind::NoPosition(words.join(" ")))?;
        let species = match (place("element"), place("type")) {
            (Some(column), _) => SpeciesColumn::Element(column),
            (None, Some(_)) if types.is_empty() => return Err(DumpErrorKind::NoElements),
            (None, Some(column)) => SpeciesColumn::Type(column),
            (None, None) => return Err(DumpErrorKind::NoType(words.join(" "))),
        };
        Ok(Self { id: place("id"), species, position, scaled, count: words.len() })
    }

    /// Whether atoms have an id.
    pub fn has_id(&self) -> bool {
        self.id.is_some()
    }

    /// Whether coordinates are fractions of the cell vectors.
    pub fn scaled(&self) -> bool {
        self.scaled
    }

    /// The atom of a line.
    pub fn atom(&self, text: &str, types: &[Species]) -> Result<DumpAtom, DumpErrorKind> {
        let words: Vec<&str> = text.split_whitespace().collect();
        if words.len() != self.count {
            return Err(DumpErrorKind::line(text, "as many values as ITEM: ATOMS names columns"));
        }
        let id = match self.id {
            Some(column) => {
                words[column].parse().map_err(|_| DumpErrorKind::line(words[column], "an integer id"))?
            }
            None => 0,
        };
        let species = match self.species {
            SpeciesColumn::Element(column) => words[column].parse()?,
            SpeciesColumn::Type(column) => {
                let number: Option<usize> = words[column].parse().ok();
                let unknown = || DumpErrorKind::Type { found: words[column].to_owned(), given: types.len() };
                *number.and_then(|number| types.get(number.checked_sub(1)?)).ok_or_else(unknown)?
            }
        };
        let mut position = [0.0; 3];
        for (x, column) in position.iter_mut().zip(self.position) {
            *x = finite(words[column])
                .ok_or_else(|| DumpErrorKind::line(words[column], "a finite coordinate"))?;
        }
        Ok(DumpAtom { id, species, position })
    }
}
