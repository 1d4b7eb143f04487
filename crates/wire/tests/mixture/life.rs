//! Versions and readers in one process.

use std::path::PathBuf;
use std::sync::Arc;

use calm::{Component, Grades, Mixture};
use tempfile::TempDir;
use wire::mixture::ORIGINAL;
use wire::{MixtureReader, SharedMixture, SharedMixtureError};

use super::helpers::{DIMENSION, check, first, next, stamped};

fn place() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    let path = folder.path().join("mixture");
    (folder, path)
}

#[test]
fn published_versions_can_be_read() {
    let (_folder, path) = place();
    let mut mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, 2).unwrap();
    let mut reader = MixtureReader::open(&path, 1).unwrap();
    for version in 0..100 {
        assert_eq!(reader.newest(), version);
        let pinned = reader.pin(version).unwrap();
        check(&pinned);
        assert_eq!(*pinned, *mixture);
        mixture = next(&mixture);
        shared.publish(&mixture).unwrap();
    }
}

#[test]
fn grades_have_the_same_bits() {
    let (_folder, path) = place();
    let mut random = super::helpers::Random(7);
    let mut number = || random.next() as f64 / u64::MAX as f64 - 0.5;
    let mut take = |count: usize| (0..count).map(|_| number()).collect::<Vec<f64>>();
    let dimension = 131;
    let mut component = || {
        let mut inverse = take(dimension * dimension);
        inverse.iter_mut().step_by(dimension + 1).for_each(|value| *value += dimension as f64);
        Arc::new(Component::new(take(dimension), inverse, 1.25, None).unwrap())
    };
    let elements = vec![vec![component(), component()], vec![component()]];
    let mixture = Mixture::new(3, elements).unwrap();
    let _shared = SharedMixture::create(&path, &mixture, 1).unwrap();
    let pinned = MixtureReader::open(&path, 0).unwrap().pin(3).unwrap();
    let (elements, features) = ([0, 1, 0, 1], take(4 * dimension));
    let grade = |mixture: &Mixture| {
        let (mut grades, mut gradient) = (Grades::default(), vec![0.0; features.len()]);
        grades.evaluate(mixture, &elements, &features, Some(&mut gradient)).unwrap();
        (grades, gradient)
    };
    assert_eq!(grade(&pinned), grade(&mixture));
}

#[test]
fn a_version_lives_while_its_arc_does() {
    let (_folder, path) = place();
    let promised = first();
    let mut shared = SharedMixture::create(&path, &promised, 1).unwrap();
    shared.publish(&promised).unwrap();
    let mut newest = Arc::clone(&promised);
    for _ in 0..20 {
        newest = next(&newest);
        shared.publish(&newest).unwrap();
    }
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    check(&reader.pin(0).unwrap());
    check(&reader.pin(20).unwrap());
    drop(promised);
    shared.publish(&next(&newest)).unwrap();
    let gone = reader.pin(0);
    assert!(matches!(gone, Err(SharedMixtureError::VersionNotFound { version: 0, newest: 21 })), "{gone:?}");
    assert!(matches!(reader.pin(7), Err(SharedMixtureError::VersionNotFound { version: 7, .. })));
    assert!(matches!(reader.pin(u64::MAX), Err(SharedMixtureError::VersionNotFound { .. })));
}

#[test]
fn the_original_mixture_stays() {
    let (_folder, path) = place();
    let original = first();
    // As in a campaign that continues: the newest version comes first.
    let mut newest = next(&next(&original));
    let mut shared = SharedMixture::create(&path, &newest, 1).unwrap();
    shared.publish_original(&original).unwrap();
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    assert_eq!(reader.newest(), 2);
    let pinned = reader.pin(ORIGINAL).unwrap();
    for version in 2..80 {
        check(&reader.pin(version).unwrap());
        newest = next(&newest);
        shared.publish(&newest).unwrap();
        assert_eq!(reader.newest(), version + 1);
    }
    let same = reader.pin(ORIGINAL).unwrap();
    assert_eq!((&*same, &*pinned), (&original.at_version(ORIGINAL), &original.at_version(ORIGINAL)));
    assert_eq!(*reader.pin(80).unwrap(), *newest);
}

#[test]
fn every_arc_of_a_version_counts() {
    let (_folder, path) = place();
    let original = first();
    let mut shared = SharedMixture::create(&path, &original, 1).unwrap();
    let copy = Arc::new(Mixture::clone(&original));
    shared.publish(&original).unwrap();
    shared.publish(&copy).unwrap();
    let mut newest = next(&original);
    drop(original);
    for _ in 0..5 {
        shared.publish(&newest).unwrap();
        newest = next(&newest);
    }
    check(&MixtureReader::open(&path, 0).unwrap().pin(0).unwrap());
    drop(copy);
    shared.publish(&newest).unwrap();
    assert!(MixtureReader::open(&path, 0).unwrap().pin(0).is_err());
}

#[test]
fn an_older_version_may_come_later() {
    let (_folder, path) = place();
    let mixtures: Vec<_> =
        std::iter::successors(Some(first()), |mixture| Some(next(mixture))).take(4).collect();
    let mut shared = SharedMixture::create(&path, &mixtures[0], 1).unwrap();
    for version in [3, 1, 2] {
        shared.publish(&mixtures[version]).unwrap();
    }
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    assert_eq!(reader.newest(), 3);
    for version in [1, 2, 3] {
        check(&reader.pin(version).unwrap());
    }
}

#[test]
fn a_component_outlives_its_mixture_its_reader_and_the_writer() {
    let (folder, path) = place();
    let mut mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, 1).unwrap();
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    let component = Arc::clone(reader.pin(0).unwrap().component(0, 0).unwrap());
    drop(reader);
    // Enough versions to reuse every block several times.
    for _ in 0..200 {
        mixture = next(&mixture);
        shared.publish(&mixture).unwrap();
    }
    assert_eq!(component, stamped(0));
    let taken = MixtureReader::open(&path, 0);
    assert!(matches!(taken, Err(SharedMixtureError::SlotTaken { reader: 0, .. })), "{taken:?}");
    drop((shared, folder));
    assert_eq!(component, stamped(0));
}

#[test]
fn slots_are_freed_when_everything_is_dropped() {
    let (_folder, path) = place();
    let mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, 2).unwrap();
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    let pinned = reader.pin(0).unwrap();
    drop((reader, pinned));
    let reader = MixtureReader::open(&path, 0).unwrap();
    // As if its process had been killed.
    std::mem::forget(reader);
    let taken = MixtureReader::open(&path, 0).unwrap_err().to_string();
    assert!(taken.contains(&std::process::id().to_string()), "{taken}");
    shared.release(0);
    shared.release(99);
    MixtureReader::open(&path, 0).unwrap();
    let none = MixtureReader::open(&path, 2);
    assert!(matches!(none, Err(SharedMixtureError::NoSlot { reader: 2, readers: 2 })), "{none:?}");
}

#[test]
fn the_same_version_is_the_same_mixture_and_unchanged_components_are_shared() {
    let (_folder, path) = place();
    let mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, 1).unwrap();
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    let old = reader.pin(0).unwrap();
    assert!(Arc::ptr_eq(&old, &reader.pin(0).unwrap()));
    shared.publish(&next(&mixture)).unwrap();
    let new = reader.pin(1).unwrap();
    for (place, ((.., old), (.., new))) in old.iter().zip(new.iter()).enumerate() {
        assert_eq!(Arc::ptr_eq(old, new), !super::helpers::changes(1, place), "component {place}");
    }
}

#[test]
fn other_shapes_are_rejected() {
    let (_folder, path) = place();
    let mut shared = SharedMixture::create(&path, &first(), 1).unwrap();
    let number = DIMENSION - 1;
    let small = || Component::new(vec![0.0; number], vec![0.0; number * number], 1.0, None).unwrap();
    let elements = |shape: [usize; 3], component: &dyn Fn() -> Arc<Component>| {
        shape.map(|count| (0..count).map(|_| component()).collect()).to_vec()
    };
    let fewer = elements([3, 1, 1], &|| stamped(1));
    let smaller = elements([3, 1, 2], &|| Arc::new(small()));
    for elements in [fewer, smaller] {
        let mixture = Arc::new(Mixture::new(1, elements).unwrap());
        let refused = shared.publish(&mixture);
        assert!(matches!(refused, Err(SharedMixtureError::Shape { version: 1 })), "{refused:?}");
    }
}

#[test]
fn leaking_versions_is_a_recoverable_error() {
    let (_folder, path) = place();
    let mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, 1).unwrap();
    let mut kept = vec![mixture];
    let refused = loop {
        let mixture = next(kept.last().unwrap());
        if let Err(error) = shared.publish(&mixture) {
            break error;
        }
        kept.push(mixture);
    };
    assert!(matches!(refused, SharedMixtureError::TooManyVersions { living: 68, .. }), "{refused}");
    // All of them can still be read, and dropping one makes room for another.
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    kept.iter().skip(1).for_each(|mixture| check(&reader.pin(mixture.version()).unwrap()));
    let mixture = next(kept.last().unwrap());
    kept.remove(1);
    shared.publish(&mixture).unwrap();
    check(&reader.pin(mixture.version()).unwrap());
}

#[test]
fn both_ends_may_go_from_thread_to_thread() {
    fn may_go<T: Send>() {}
    may_go::<SharedMixture>();
    may_go::<MixtureReader>();
}
