//! Small structures without symmetry.

use atoms::cell::{Matrix3, row_times};
use atoms::{Cell, Structure};

fn structure(symbol: &str, cell: Matrix3, positions: &[[f64; 3]]) -> Structure {
    let species = vec![symbol.parse().unwrap(); positions.len()];
    Structure { species, positions: positions.to_vec(), cell: Cell(cell), periodic: [true; 3] }
}

/// Two atoms of fcc aluminium in a tetragonal cell, one of them displaced.
pub fn aluminium() -> Structure {
    let edge = 4.05 / 2.0_f64.sqrt();
    let cell = [[edge, 0.0, 0.0], [0.0, edge, 0.0], [0.0, 0.0, 4.05]];
    structure("Al", cell, &[[0.0; 3], [edge / 2.0 + 0.3, edge / 2.0 - 0.2, 2.025 + 0.25]])
}

/// The primitive cell of silicon, strained and displaced.
pub fn silicon() -> Structure {
    let cell = [[0.0, 2.75, 2.7], [2.72, 0.05, 2.75], [2.68, 2.72, -0.04]];
    structure("Si", cell, &[[0.0; 3], [1.43, 1.33, 1.30]])
}

/// A stretched molecule without periodicity.
pub fn oxygen() -> Structure {
    let molecule = structure("O", [[0.0; 3]; 3], &[[0.0; 3], [0.3, 0.2, 1.26]]);
    Structure { periodic: [false; 3], ..molecule }
}

/// The primitive cell of bcc iron, slightly strained.
pub fn iron() -> Structure {
    let half = 2.83 / 2.0;
    let cell = [[-half, half, half], [half, -half, half + 0.03], [half, half + 0.02, -half]];
    structure("Fe", cell, &[[0.0; 3]])
}

/// Cell and positions times 1 + `strain`.
pub fn strained(of: &Structure, strain: &Matrix3) -> Structure {
    let mut deformation = *strain;
    (0..3).for_each(|i| deformation[i][i] += 1.0);
    let mut structure = of.clone();
    structure.cell = Cell(of.cell.0.map(|row| row_times(row, &deformation)));
    structure.positions = of.positions.iter().map(|r| row_times(*r, &deformation)).collect();
    structure
}
