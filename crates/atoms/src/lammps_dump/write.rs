//! Writes text dumps in LAMMPS' units `metal`.

use std::io::{self, Write};

use crate::cell::{Cell, Matrix3, Vec3, dot, scale};
use crate::structure::Structure;

/// Smallest extent of the box in a direction that is not periodic, Å.
const LEAST_EXTENT: f64 = 1.0;

/// fs per ps.
const FEMTOSECONDS: f64 = 1000.0;

/// A snapshot.
pub struct DumpSnapshot<'a> {
    /// The structure.
    pub structure: &'a Structure,
    /// Number of the step.
    pub timestep: u64,
    /// fs.
    pub time: f64,
    /// [n], if they are known.
    pub motion: Option<DumpMotion<'a>>,
    /// Further columns: name, and [n] numbers.
    pub scalars: Vec<(&'a str, &'a [f64])>,
}

/// Velocities and forces of a snapshot.
pub struct DumpMotion<'a> {
    /// [n], Å/fs.
    pub velocities: &'a [Vec3],
    /// [n], eV/Å.
    pub forces: &'a [Vec3],
}

/// Writes a snapshot: unwrapped positions (Å), velocities (Å/ps) and forces (eV/Å). A cell that is not orthogonal is written as a general
/// triclinic box (`abc origin`), so that nothing is rotated. In directions that are not periodic, the box encloses the atoms. Types count
/// the elements of the structure in the order of their first atoms.
///
/// # Errors
/// Those of `out`.
pub fn write_snapshot(out: &mut impl Write, snapshot: &DumpSnapshot<'_>) -> io::Result<()> {
    let DumpSnapshot { structure, .. } = snapshot;
    let mut text = Vec::new();
    writeln!(text, "ITEM: UNITS\nmetal\nITEM: TIME\n{}", snapshot.time / FEMTOSECONDS)?;
    writeln!(text, "ITEM: TIMESTEP\n{}\nITEM: NUMBER OF ATOMS\n{}", snapshot.timestep, structure.len())?;
    write_box(&mut text, structure)?;
    let motion = if snapshot.motion.is_some() { " vx vy vz fx fy fz" } else { "" };
    write!(text, "ITEM: ATOMS id type element xu yu zu{motion}")?;
    snapshot.scalars.iter().try_for_each(|(name, _)| write!(text, " {name}"))?;
    writeln!(text)?;
    let mut elements = Vec::new();
    for (atom, species) in structure.species.iter().enumerate() {
        let kind = elements.iter().position(|known| known == species).unwrap_or_else(|| {
            elements.push(*species);
            elements.len() - 1
        });
        write!(text, "{} {} {}", atom + 1, kind + 1, species.symbol())?;
        let motion = snapshot.motion.iter().flat_map(|DumpMotion { velocities, forces }| {
            [velocities[atom].map(|v| v * FEMTOSECONDS), forces[atom]]
        });
        for number in std::iter::once(structure.positions[atom]).chain(motion).flatten() {
            write!(text, " {number}")?;
        }
        snapshot.scalars.iter().try_for_each(|(_, numbers)| write!(text, " {}", numbers[atom]))?;
        writeln!(text)?;
    }
    out.write_all(&text)
}

fn write_box(out: &mut Vec<u8>, structure: &Structure) -> io::Result<()> {
    let (origin, Cell(rows)) = enclosing_box(structure);
    let flags = structure.periodic.map(|periodic| if periodic { "pp" } else { "ff" }).join(" ");
    if is_orthogonal(&rows) {
        writeln!(out, "ITEM: BOX BOUNDS {flags}")?;
        return (0..3).try_for_each(|k| writeln!(out, "{} {}", origin[k], origin[k] + rows[k][k]));
    }
    writeln!(out, "ITEM: BOX BOUNDS abc origin {flags}")?;
    rows.iter().zip(origin).try_for_each(|([x, y, z], origin)| writeln!(out, "{x} {y} {z} {origin}"))
}

fn is_orthogonal(rows: &Matrix3) -> bool {
    (0..3).all(|i| (0..3).all(|j| if i == j { rows[i][j] > 0.0 } else { rows[i][j] == 0.0 }))
}

/// Lowest corner and vectors of a box around the structure.
fn enclosing_box(structure: &Structure) -> (Vec3, Cell) {
    let mut cell = structure.cell.completed(structure.periodic);
    let normals = cell.reciprocal();
    let mut origin = [0.0; 3];
    for k in (0..3).filter(|k| !structure.periodic[*k]) {
        let heights = structure.positions.iter().map(|position| dot(normals[k], *position));
        let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), height| {
            (low.min(height), high.max(height))
        });
        let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
        let extent = (high - low).max(LEAST_EXTENT);
        let corner = scale(cell.0[k], 0.5 * (low + high - extent));
        origin = std::array::from_fn(|axis| origin[axis] + corner[axis]);
        cell.0[k] = scale(cell.0[k], extent);
    }
    (origin, cell)
}
