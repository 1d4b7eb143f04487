use std::sync::Arc;

use atoms::{Cell, Evaluation, Species, Structure};

use super::*;
use crate::structure_files::Structures;

fn structure(cell: [[f64; 3]; 3], periodic: [bool; 3]) -> Structure {
    let species = ["Ni", "Al", "Ni"].map(|symbol| symbol.parse::<Species>().unwrap());
    let positions = vec![[0.1, -0.2, 1.0 / 3.0], [1.5, 2.25, 0.7], [2.9, 0.3, 4.1]];
    Structure { species: species.to_vec(), positions, cell: Cell(cell), periodic }
}

/// The frames of a file with two steps of a structure.
fn written_and_read(name: &str, structure: &Structure, has_motion: bool) -> Vec<Structure> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(name);
    let evaluation = Evaluation {
        atomic_energies: vec![-1.0, -2.0, -0.5],
        forces: vec![[0.1, 0.2, -0.3]; 3],
        virial: [[0.5, 0.0, 0.0]; 3],
    };
    let mut trajectory = Trajectory::create(&path).unwrap();
    for step in [0, 50] {
        trajectory
            .push(&TrajectoryStep {
                structure,
                motion: has_motion.then_some(StepMotion {
                    velocities: &[[0.001, -0.002, 0.0]; 3],
                    masses: &[58.7, 27.0, 58.7],
                    evaluation: &evaluation,
                }),
                segment: Some(1),
                step,
                time: 2.0 * step as f64,
                temperature: 300.0,
                gamma: Some(&[0.5, 1.5, 0.25]),
            })
            .unwrap();
    }
    assert_eq!(trajectory.frames, 2);
    trajectory.finish().unwrap();
    let mut found = Structures::open(&path, &[], &Arc::default()).unwrap();
    std::iter::from_fn(|| found.next(&path)).map(|frame| frame.unwrap().structure).collect()
}

#[test]
fn every_format_has_the_bits_of_the_structure() {
    let skew = [[4.0, 0.1, 0.0], [-0.3, 5.0, 0.2], [0.0, 0.4, 6.0]];
    for cell in [skew, [[4.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 6.0]]] {
        let structure = structure(cell, [true; 3]);
        for name in
            ["a.extxyz", "a.XYZ", "a.xyz.gz", "a.extxyz.zst", "a.dump", "a.lammpstrj.gz", "a.dump.zst"]
        {
            for has_motion in [true, false] {
                let found = written_and_read(name, &structure, has_motion);
                assert_eq!(found, [structure.clone(), structure.clone()], "{name}");
            }
        }
    }
}

#[test]
fn a_dump_of_a_slab_or_cluster_has_a_box_around_it() {
    let slab = structure([[4.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0; 3]], [true, true, false]);
    let cluster = structure([[0.0; 3]; 3], [false; 3]);
    for (structure, size) in [(slab, [4.0, 5.0, 4.1 - 1.0 / 3.0]), (cluster, [2.8, 2.45, 4.1 - 1.0 / 3.0])] {
        for found in written_and_read("a.dump", &structure, true) {
            assert_eq!((found.periodic, &found.species), (structure.periodic, &structure.species));
            // Positions count from the lowest corner of the box.
            for (a, b) in [(0, 1), (0, 2)] {
                for axis in 0..3 {
                    let distance = |of: &Structure| of.positions[b][axis] - of.positions[a][axis];
                    assert!((distance(&found) - distance(&structure)).abs() < 1e-12);
                }
            }
            for (axis, expected) in size.iter().enumerate() {
                assert!((found.cell.0[axis][axis] - expected).abs() < 1e-12, "{:?}", found.cell);
            }
        }
    }
}

#[test]
fn names_of_trajectories_are_checked() {
    for name in ["a.extxyz", "B.XYZ.GZ", "x/y.lammpstrj.zst", "a.dump"] {
        assert_eq!(check_name(name), Ok(name.into()));
    }
    for name in ["a.npz", "extxyz", "a.gz", "a.dump.bz2", ""] {
        assert!(check_name(name).is_err(), "{name}");
    }
}
