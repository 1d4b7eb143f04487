//! Faulty output gives no label, or the same one.

use dft::{Exit, FailureClass};
use proptest::prelude::*;

use super::{assert_close, expected, read, text};

#[test]
fn whole_files_are_read() {
    let (xml, outcar) = (text("vasprun.xml"), text("OUTCAR"));
    let both =
        read(&[("vasprun.xml", xml.as_bytes()), ("OUTCAR", outcar.as_bytes())], Exit::Code(0)).unwrap();
    assert_close(&both, &expected(), 1e-12);
    // A complete file is valid however the program ended afterwards.
    let killed = read(&[("vasprun.xml", xml.as_bytes()), ("OUTCAR", outcar.as_bytes())], Exit::TimeLimit);
    assert_eq!(killed, Ok(both.clone()));
    let xml_only = read(&[("vasprun.xml", xml.as_bytes())], Exit::Code(0)).unwrap();
    assert_eq!((xml_only.energy, &xml_only.forces), (both.energy, &both.forces));
    assert_eq!((xml_only.magnetic_moments, xml_only.magnetisation), (None, None));
    // OUTCAR has six decimals of a force, and five of a stress in kB.
    let outcar_only = read(&[("OUTCAR", outcar.as_bytes())], Exit::Code(0)).unwrap();
    assert_close(&outcar_only, &expected(), 6e-7);
}

#[test]
fn without_any_file_the_end_of_the_program_tells_the_class() {
    for (exit, class) in [
        (Exit::Code(0), FailureClass::Crashed),
        (Exit::Code(1), FailureClass::Crashed),
        (Exit::Signal(11), FailureClass::Crashed),
        (Exit::TimeLimit, FailureClass::TimeLimit),
        (Exit::OutOfMemory, FailureClass::OutOfMemory),
        (Exit::LostNode, FailureClass::NodeFailure),
    ] {
        assert_eq!(read(&[], exit).unwrap_err().class, class, "{exit:?}");
    }
    let words = b" WARNING\n BRMIX: very serious problems\n the old and the new charge density differ\n";
    let failure = read(&[("stdout", words)], Exit::Code(0)).unwrap_err();
    assert_eq!(failure.class, FailureClass::NotConverged);
    assert_eq!(read(&[("stdout", words)], Exit::TimeLimit).unwrap_err().class, FailureClass::TimeLimit);
}

/// The failure after one change to a file, without the other file.
fn changed(name: &str, from: &str, to: &str) -> FailureClass {
    let text = text(name);
    assert!(text.contains(from), "{name} has no {from:?}");
    match read(&[(name, text.replace(from, to).as_bytes())], Exit::Code(0)) {
        Ok(calculated) => panic!("{name} with {to:?} for {from:?} is believed: {calculated:?}"),
        Err(failure) => failure.class,
    }
}

#[test]
fn changes_in_vasprun_are_seen() {
    let changed = |from: &str, to: &str| changed("vasprun.xml", from, to);
    use FailureClass::*;
    // Numbers.
    assert_eq!(changed("     -0.50000000       0.25000000", "            NaN       0.25000000"), Implausible);
    assert_eq!(changed("     -0.50000000       0.25000000", "**************** 0.25000000"), Implausible);
    assert_eq!(changed("   -120.50000000", "****************"), Implausible);
    assert_eq!(changed("    -24.30612345 ", "         NaN"), Implausible);
    assert_eq!(changed("    -24.30612345 ", " ***********"), Implausible);
    assert_eq!(changed("     -0.50000000       0.25000000", "     -0.5000-000       0.25000000"), Crashed);
    assert_eq!(changed("    -24.30612345 ", " minus twenty-four "), Crashed);
    // Atoms.
    let force = "   <v>      -0.50000000       0.25000000       1.75000000 </v>\n";
    assert_eq!(changed(force, ""), Implausible);
    assert_eq!(changed(force, &force.repeat(2)), Implausible);
    assert_eq!(changed("    <rc><c>O </c><c>   2</c></rc>\n", ""), Implausible);
    assert_eq!(changed("<rc><c>O </c>", "<rc><c>S </c>"), Implausible);
    assert_eq!(changed("<rc><c>O </c>", "<rc><c>Qq</c>"), Crashed);
    let position = "   <v>       0.45000000       0.15000000       0.75000000 </v>\n";
    assert_eq!(changed(position, ""), Implausible);
    assert_eq!(changed(position, &position.replace("0.15", "0.16")), Implausible);
    assert_eq!(changed(position, &position.replace("0.15000000", "**********")), Implausible);
    // Cell.
    assert_eq!(
        changed("       0.40000000       4.30000000", "       0.40000000       4.31000000"),
        Implausible
    );
    assert_eq!(changed("   <v>       0.40000000       4.30000000       0.00000000 </v>\n", ""), Crashed);
    // Convergence and version.
    assert_eq!(
        changed("<i type=\"int\" name=\"NELM\">    60</i>", "<i type=\"int\" name=\"NELM\">     3</i>"),
        NotConverged
    );
    assert_eq!(changed(" </calculation>\n", " </calculation>\n <calculation></calculation>\n"), Crashed);
    assert_eq!(changed("5.4.4.18Apr17", "5.4.1"), OtherProgram);
}

#[test]
fn outcar_is_asked_whether_it_converged() {
    // As if something had ended the electronic steps before the limit.
    let outcar = text("OUTCAR").replace("because EDIFF is reached", "EDIFF was not reached");
    let files = [("vasprun.xml", text("vasprun.xml")), ("OUTCAR", outcar)];
    let failure =
        read(&files.each_ref().map(|(name, text)| (*name, text.as_bytes())), Exit::Code(0)).unwrap_err();
    assert_eq!(failure.class, FailureClass::NotConverged);
}

#[test]
fn changes_in_outcar_are_seen() {
    let changed = |from: &str, to: &str| changed("OUTCAR", from, to);
    use FailureClass::*;
    assert_eq!(changed("-0.500000      0.250000", "      NaN      0.250000"), Implausible);
    assert_eq!(changed("-0.500000      0.250000", "*********      0.250000"), Implausible);
    assert_eq!(changed("-24.30612345 eV\n\n  energy  ", "************ eV\n\n  energy  "), Implausible);
    assert_eq!(
        changed("ions per type =               2   1", "ions per type =               2   2"),
        Implausible
    );
    assert_eq!(
        changed("ions per type =               2   1", "ions per type =               3"),
        Implausible
    );
    assert_eq!(changed("TITEL  = PAW_PBE O", "TITEL  = PAW_PBE S"), Implausible);
    assert_eq!(changed("    0.400000000  4.300000000", "    0.400000000  4.310000000"), Implausible);
    assert_eq!(
        changed("aborting loop because EDIFF is reached", "aborting loop EDIFF was not reached"),
        NotConverged
    );
    assert_eq!(changed("NELM   =     60", "NELM   =      3"), NotConverged);
    assert_eq!(changed(" vasp.5.4.4.", " vasp.6.4.4."), OtherProgram);
    assert_eq!(changed("General timing", "general timing"), Crashed);
}

proptest! {
    #[test]
    fn files_cut_at_any_byte_are_no_label(xml in 0.0..1.0, outcar in 0.0..1.0) {
        let (xml_whole, outcar_whole) = (text("vasprun.xml"), text("OUTCAR"));
        // Up to the last required element.
        let xml_end = xml_whole.trim_end().len();
        let outcar_end = outcar_whole.find("General timing").unwrap();
        let xml = &xml_whole.as_bytes()[..(xml_end as f64 * xml) as usize];
        let outcar = &outcar_whole.as_bytes()[..(outcar_end as f64 * outcar) as usize];
        for exit in [Exit::Code(0), Exit::Code(1)] {
            let failure = read(&[("vasprun.xml", xml), ("OUTCAR", outcar)], exit).unwrap_err();
            prop_assert_eq!(failure.class, FailureClass::Crashed);
        }
        // The other file has the label if it is complete.
        let from_outcar =
            read(&[("vasprun.xml", xml), ("OUTCAR", outcar_whole.as_bytes())], Exit::Code(0)).unwrap();
        assert_close(&from_outcar, &expected(), 6e-7);
        let from_xml = read(&[("vasprun.xml", xml_whole.as_bytes()), ("OUTCAR", outcar)], Exit::Code(0)).unwrap();
        prop_assert_eq!((from_xml.energy, from_xml.forces), (expected().energy, expected().forces));
        prop_assert!(from_xml.magnetic_moments.is_none_or(|moments| moments == [0.5, 1.5, -0.25]));
    }

    #[test]
    fn no_bytes_end_in_a_panic(at in 0.0..1.0, byte: u8) {
        for name in ["vasprun.xml", "OUTCAR"] {
            let mut bytes = text(name).into_bytes();
            let at = (bytes.len() as f64 * at) as usize;
            bytes[at] = byte;
            // Most bytes are irrelevant; whatever is read is finite and of these atoms.
            if let Ok(calculated) = read(&[(name, &bytes)], Exit::Code(0)) {
                prop_assert_eq!(calculated.forces.len(), 3);
                prop_assert!(calculated.forces.iter().flatten().all(|x| x.is_finite()));
            }
        }
    }
}
