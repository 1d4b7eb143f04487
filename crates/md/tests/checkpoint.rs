//! A run that stops and resumes equals one that never stopped, bit for bit.

use md::{
    BarostatSettings, CellFreedom, Checkpoint, Dynamics, DynamicsError, DynamicsSettings, Langevin,
    NoseHooverChain, State, Thermostat, VelocityRescaling, VolumeRamp,
};

use crate::common::{LennardJones, argon_crystal, settings, with_barostat};

fn thermostats() -> [Thermostat; 4] {
    [
        Thermostat::None,
        Thermostat::Langevin(Langevin { temperature: 90.0, friction: 0.01 }),
        Thermostat::NoseHooverChain(NoseHooverChain::new(90.0, 100.0, 3)),
        Thermostat::VelocityRescaling(VelocityRescaling {
            temperature: 90.0,
            relaxation_time: 100.0,
            heat: 0.0,
        }),
    ]
}

fn start(thermostat: Thermostat, periodic: [bool; 3], skin: f64) -> (Dynamics, LennardJones) {
    let mut structure = argon_crystal(2);
    structure.periodic = periodic;
    let settings = DynamicsSettings { skin, ..settings(5.0, thermostat) };
    let state = State::thermal(structure, 90.0, &settings.stream);
    let ramp = Some(VolumeRamp::new(&state, 1.0, 1.2, 150));
    let mut potential = LennardJones::argon();
    let dynamics =
        Dynamics::new(state, DynamicsSettings { cell_motion: ramp.into(), ..settings }, &mut potential)
            .unwrap();
    (dynamics, potential)
}

/// The bytes of a checkpoint: equal bytes, equal bits.
fn bytes(checkpoint: &Checkpoint) -> Vec<u8> {
    postcard::to_allocvec(checkpoint).unwrap()
}

/// A run with a barostat, whose cell is soon reduced (it begins skew) and reflected (it begins at the boundary).
fn start_with_barostat(
    thermostat: Thermostat,
    periodic: [bool; 3],
    cell: CellFreedom,
) -> (Dynamics, LennardJones) {
    let mut structure = argon_crystal(2);
    structure.periodic = periodic;
    if cell == CellFreedom::Flexible {
        structure.cell.0[1] = [21.6, 10.8, 0.0];
    }
    let barostat = BarostatSettings { cell, relaxation_time: 300.0, ..BarostatSettings::default() };
    let settings = with_barostat(settings(5.0, thermostat), &barostat, 90.0, &structure);
    let state = State::thermal(structure, 90.0, &settings.stream);
    let mut potential = LennardJones::argon();
    let mut dynamics = Dynamics::new(state, settings, &mut potential).unwrap();
    let volume = dynamics.barostat().unwrap().reference_volume;
    dynamics.set_volume_range(Some([0.98 * volume, 1.02 * volume])).unwrap();
    (dynamics, potential)
}

#[test]
fn resumed_runs_are_the_same_bit_for_bit() {
    for thermostat in thermostats() {
        for periodic in [[true; 3], [true, true, false], [false; 3]] {
            resumes(start(thermostat.clone(), periodic, 0.6));
        }
        for periodic in [[true; 3], [true, true, false], [false, false, true]] {
            for cell in [CellFreedom::Flexible, CellFreedom::Isotropic, CellFreedom::FixedAngles] {
                let whole = resumes(start_with_barostat(thermostat.clone(), periodic, cell));
                let reflections = whole.barostat().unwrap().reflections;
                assert!(reflections > 0, "{reflections} reflections");
            }
        }
    }
}

/// Makes 200 steps in one piece and in two, and returns the end.
fn resumes((mut whole, mut potential): (Dynamics, LennardJones)) -> Dynamics {
    let mut stored = Vec::new();
    for step in 0..200 {
        if step == 97 {
            stored = bytes(whole.checkpoint());
        }
        whole.step(&mut potential).unwrap();
    }
    assert_eq!(potential.evaluations, 201);

    let mut potential = LennardJones::argon();
    // Another skin, so that the list is rebuilt at other times.
    let mut resumed = Dynamics::resume(postcard::from_bytes(&stored).unwrap(), 7.0, 0.25).unwrap();
    assert_eq!(potential.evaluations, 0);
    (97..200).for_each(|_| resumed.step(&mut potential).unwrap());
    assert_eq!(potential.evaluations, 103);
    assert_eq!(resumed.state().step, 200);
    assert_eq!(bytes(resumed.checkpoint()), bytes(whole.checkpoint()));
    whole
}

#[test]
fn a_new_segment_takes_other_random_numbers() {
    let (dynamics, mut potential) = start(thermostats()[1].clone(), [true; 3], 0.6);
    let mut other = dynamics.checkpoint().clone();
    other.stream.segment += 1;
    let [mut first, mut second] = [dynamics.checkpoint().clone(), other]
        .map(|checkpoint| Dynamics::resume(checkpoint, 7.0, 0.6).unwrap());
    first.step(&mut potential).unwrap();
    second.step(&mut potential).unwrap();
    assert_ne!(first.structure().positions, second.structure().positions);
}

/// A ramp to a negative volume.
fn endless_collapse(checkpoint: &Checkpoint) -> VolumeRamp {
    VolumeRamp::new(&checkpoint.state, 1.0, -1.0, 10)
}

#[test]
fn broken_checkpoints_are_refused() {
    let (dynamics, _) = start(thermostats()[2].clone(), [true; 3], 0.6);
    let refused = |spoil: fn(&mut Checkpoint)| {
        let mut checkpoint = dynamics.checkpoint().clone();
        spoil(&mut checkpoint);
        Dynamics::resume(checkpoint, 7.0, 0.6).map(|_| ()).unwrap_err()
    };
    let length = |array, found| DynamicsError::Length { array, found, expected: 32 };
    assert_eq!(refused(|c| c.state.velocities.truncate(3)), length("velocities", 3));
    assert_eq!(refused(|c| c.evaluation.forces.clear()), length("forces", 0));
    assert_eq!(refused(|c| c.evaluation.atomic_energies.push(0.0)), length("atomic energies", 33));
    assert_eq!(refused(|c| c.time_step = 0.0), DynamicsError::TimeStep(0.0));
    assert!(matches!(refused(|c| c.state.structure.positions[3][0] = f64::NAN), DynamicsError::Structure(_)));
    assert!(matches!(refused(|c| c.cell_motion = endless_collapse(c).into()), DynamicsError::Ramp { .. }));
    for thermostat in [
        Thermostat::NoseHooverChain(NoseHooverChain::new(90.0, 100.0, 0)),
        Thermostat::NoseHooverChain(NoseHooverChain::new(0.0, 100.0, 3)),
        Thermostat::Langevin(Langevin { temperature: 90.0, friction: 0.0 }),
        Thermostat::Langevin(Langevin { temperature: f64::NAN, friction: 0.1 }),
        Thermostat::VelocityRescaling(VelocityRescaling {
            temperature: 90.0,
            relaxation_time: 0.0,
            heat: 0.0,
        }),
        Thermostat::VelocityRescaling(VelocityRescaling {
            temperature: 90.0,
            relaxation_time: 1.0,
            heat: f64::NAN,
        }),
    ] {
        let checkpoint = Checkpoint { thermostat, ..dynamics.checkpoint().clone() };
        assert!(matches!(Dynamics::resume(checkpoint, 7.0, 0.6), Err(DynamicsError::Thermostat(_))));
    }
}

#[test]
fn an_exploding_run_ends_in_an_error() {
    let mut structure = argon_crystal(2);
    structure.positions[1] = structure.positions[0];
    let settings = settings(5.0, Thermostat::None);
    let state = State { velocities: vec![[0.0; 3]; structure.len()], structure, step: 0 };
    let error = Dynamics::new(state, settings, &mut LennardJones::argon()).map(|_| ()).unwrap_err();
    assert_eq!(error, DynamicsError::NotFinite { atom: 0, step: 0 });
}

#[test]
fn light_elements_take_the_short_time_step() {
    let species =
        |symbols: &[&str]| -> Vec<atoms::Species> { symbols.iter().map(|s| s.parse().unwrap()).collect() };
    for light in ["H", "He", "Li", "Be"] {
        assert_eq!(md::default_time_step(&species(&["W", light])), 0.5);
    }
    assert_eq!(md::default_time_step(&species(&["B", "W"])), 2.0);
}
