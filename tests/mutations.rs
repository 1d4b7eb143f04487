//! Randomly damaged files of every kind that a campaign reads: each is read, or refused with an error that names it.
//!
//! `CALMWALK_MUTATIONS=5000 cargo test --test integration mutations::` tries 5000 mutations of each kind. The number in a
//! failure message reproduces the file.

use std::fs;
use std::io::{Cursor, Read, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;

use atoms::{NeighbourList, Structure};
use calm::Artifact;
use npyz::npz::{NpzArchive, NpzWriter};
use potentials::grace::{Grace, GraceModel};
use potentials::{Eam, EamStyle, StillingerWeber};
use wire::{CandidateBlock, ContentHash};

use crate::common;
use crate::common::config;
use crate::common::mutate::{mutated, mutations};

/// Passes damaged files of this name to a reader, which returns its error if it refuses one.
fn read_all(
    name: &str,
    number: u64,
    damaged: impl Fn(u64) -> Vec<u8>,
    read: impl Fn(&Path) -> Result<(), String>,
) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(name);
    let mut refused = 0;
    for number in 0..mutations(number) {
        fs::write(&path, damaged(number)).unwrap();
        let found = catch_unwind(AssertUnwindSafe(|| read(&path)));
        let found = found.unwrap_or_else(|_| panic!("{name}: a panic at mutation {number}"));
        if let Err(why) = found {
            refused += 1;
            assert!(why.contains(name), "{name}, mutation {number}: the error does not name the file: {why}");
            assert!(why.len() < 2000, "{name}, mutation {number}: {} bytes of error", why.len());
        }
    }
    assert!(refused > 0, "{name}: nothing was refused");
}

/// The same with mutations of an existing file.
fn of_file(name: &str, number: u64, file: &Path, read: impl Fn(&Path) -> Result<(), String>) {
    let bytes = fs::read(file).unwrap();
    assert_eq!(read(file), Ok(()), "{name}");
    read_all(name, number, |number| mutated(&bytes, number), read);
}

fn structure() -> Structure {
    atoms::read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap().remove(0).structure
}

fn text(error: impl ToString) -> String {
    error.to_string()
}

#[test]
fn structures() {
    let seeds = config("data/aluminium_seeds.extxyz");
    of_file("seeds.extxyz", 400, &seeds, |path| atoms::read_structures(path).map(drop).map_err(text));
    let mut poscar = Vec::new();
    atoms::poscar::write_poscar(&mut poscar, &structure(), "a comment").unwrap();
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("POSCAR");
    fs::write(&file, poscar).unwrap();
    of_file("POSCAR", 400, &file, |path| atoms::read_structures(path).map(drop).map_err(text));
}

#[test]
fn classical_potentials() {
    let eam = config("data/Al_mm.eam.fs");
    of_file("Al.eam.fs", 30, &eam, |path| {
        Eam::load_as(path, EamStyle::FinnisSinclair).map(drop).map_err(text)
    });
    of_file("Si.sw", 300, &config("data/Si.sw"), |path| StillingerWeber::load(path).map(drop).map_err(text));
}

/// The members of an archive.
fn members(file: &Path) -> Vec<(String, Vec<u8>)> {
    let mut archive = NpzArchive::open(file).unwrap();
    let zip = archive.zip_archive();
    let number = zip.len();
    let read = |index| {
        let mut member = zip.by_index(index).unwrap();
        let mut bytes = Vec::new();
        member.read_to_end(&mut bytes).unwrap();
        (member.name().to_owned(), bytes)
    };
    (0..number).map(read).collect()
}

/// An archive with one damaged member and valid checksums.
fn with_damaged_member(members: &[(String, Vec<u8>)], number: u64) -> Vec<u8> {
    let chosen = (common::random(number) % members.len() as u64) as usize;
    let mut out = NpzWriter::new(Cursor::new(Vec::new()));
    for (index, (name, bytes)) in members.iter().enumerate() {
        out.zip_writer().start_file(name.as_str(), Default::default()).unwrap();
        let damaged = if index == chosen { mutated(bytes, number) } else { bytes.clone() };
        out.zip_writer().write_all(&damaged).unwrap();
    }
    out.zip_writer().finish().unwrap().into_inner()
}

/// Reads a model. If that succeeds, evaluates a structure, which may return an error.
fn read_model(path: &Path) -> Result<(), String> {
    let model = Arc::new(GraceModel::load(path).map_err(text)?);
    Artifact::load_export(path).map_err(text)?;
    let (structure, mut neighbours) = (structure(), NeighbourList::new(model.cutoff(), 0.0));
    // The cutoff may be arbitrary: the neighbour list refuses one that does not suit the structure.
    if neighbours.update(&structure).is_ok() {
        let _ = Grace::new(model).forward(&structure, &neighbours);
    }
    Ok(())
}

#[test]
fn models() {
    let file = config("data/al_eam_1l/kokkos.npz");
    of_file("kokkos.npz", 10, &file, read_model);
    let members = members(&file);
    read_all("kokkos.npz", 40, |number| with_damaged_member(&members, number), read_model);
}

#[test]
fn artifacts() {
    let file = config("data/al_eam_1l/gmm_artifacts.npz");
    let read = |path: &Path| Artifact::load(path).map(drop).map_err(text);
    of_file("gmm_artifacts.npz", 10, &file, read);
    let members = members(&file);
    read_all("gmm_artifacts.npz", 40, |number| with_damaged_member(&members, number), read);
}

/// Blocks have no file name, so their errors are not checked for it.
#[test]
fn candidates() {
    let structure = structure();
    let n = structure.len();
    let candidate = wire::Candidate {
        id: wire::CandidateId {
            campaign: wire::CampaignId([7; 16]),
            walk: wire::WalkId(3),
            segment: 0,
            step: 5,
            content: ContentHash::from_structure(&structure),
        },
        origin: wire::Origin::Biased,
        mixture_version: 3,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: -1.0,
        virial: [[0.5; 3]; 3],
        forces: vec![[0.25; 3]; n],
        gamma: vec![1.0; n],
        gamma_nbr: vec![2.0; n],
        features: vec![0.5; n * 20],
        structure,
    };
    let bytes = CandidateBlock::encode(&candidate).as_bytes().to_vec();
    for number in 0..mutations(400) {
        let damaged = mutated(&bytes, number);
        for bytes in [damaged.clone(), with_checksum(damaged)] {
            let Ok(block) = CandidateBlock::from_bytes(&bytes) else { continue };
            let found = block.view().to_candidate();
            assert_eq!(CandidateBlock::encode(&found).as_bytes(), bytes, "mutation {number}");
        }
    }
}

/// Sets the correct length and checksum, so that the code behind these checks is reached.
fn with_checksum(mut bytes: Vec<u8>) -> Vec<u8> {
    let length = bytes.len() as u64;
    if let Some(place) = bytes.get_mut(16..24) {
        place.copy_from_slice(&length.to_le_bytes());
        let checksum = crc32fast::hash(&bytes[16..]).to_le_bytes();
        bytes[12..16].copy_from_slice(&checksum);
    }
    bytes
}
