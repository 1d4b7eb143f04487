//! Benchmark of the shared mixture: its creation, evaluation compared with private memory, and the delay until 16 other
//! processes see a new component.
//!
//! `cargo bench -p wire --bench shared_mixture` needs about 1.5 GB of memory, 0.5 GB of it in /dev/shm.

use std::hint::black_box;
use std::io::{Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use calm::{ChangedComponent, Component, Grades, Mixture};
use rustix::time::{ClockId, clock_gettime};
use wire::{MixtureReader, SharedMixture};

const READERS: u32 = 16;

/// Number of elements, components per element, and features.
#[derive(Clone, Copy)]
struct Size {
    name: &'static str,
    elements: usize,
    components: usize,
    dimension: usize,
    /// Number of independent copies in memory.
    placements: usize,
}

const SMALL: Size =
    Size { name: "2 × 4, D = 130", elements: 2, components: 4, dimension: 130, placements: 8 };
const FOUNDATION: Size =
    Size { name: "89 × 16, D = 132", elements: 89, components: 16, dimension: 132, placements: 2 };

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if let [_, kind, path, number] = &arguments[..]
        && kind == "reader"
    {
        return read(Path::new(path), number.parse().expect("a reader's number"));
    }
    let folder = tempfile::tempdir_in("/dev/shm").expect("/dev/shm can be written");
    for size in [SMALL, FOUNDATION] {
        println!("{}", size.name);
        let mixture = Arc::new(Mixture::new(0, elements(size)).expect("equal dimensions"));
        creation(&folder.path().join("mixture"), &mixture);
        evaluation(folder.path(), size, &mixture);
        visibility(&folder.path().join("mixture"), size, mixture);
    }
}

/// The clock that all processes share, ns.
fn now() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Numbers between −½ and ½ (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as f64 / u64::MAX as f64 - 0.5
    }
}

fn component(random: &mut Random, dimension: usize) -> Arc<Component> {
    let mut inverse: Vec<f64> = (0..dimension * dimension).map(|_| random.next()).collect();
    inverse.iter_mut().step_by(dimension + 1).for_each(|value| *value += dimension as f64);
    let centroid = (0..dimension).map(|_| 10.0 * random.next()).collect();
    Arc::new(Component::new(centroid, inverse, 1.0, None).expect("finite numbers"))
}

fn elements(size: Size) -> Vec<Vec<Arc<Component>>> {
    let mut random = Random(1);
    let mut components =
        || (0..size.components).map(|_| component(&mut random, size.dimension)).collect::<Vec<_>>();
    (0..size.elements).map(|_| components()).collect()
}

fn creation(path: &Path, mixture: &Mixture) {
    let start = now();
    let shared = SharedMixture::create(path, mixture, READERS).expect("room in /dev/shm");
    let created = now();
    let mut reader = MixtureReader::open(path, 0).expect("a sound file");
    drop(reader.pin(0));
    let pinned = now();
    let megabytes = 512.0 * std::fs::metadata(path).expect("the file").blocks() as f64 / 1e6;
    let milliseconds = |time: u64| time as f64 / 1e6;
    println!(
        "  created in {:.2} ms, {megabytes:.1} MB in /dev/shm; opened and first pinned in {:.3} ms",
        milliseconds(created - start),
        milliseconds(pinned - created)
    );
    drop(shared);
}

/// γ and its gradient, private and shared, in pairs of alternating order for several copies of each.
fn evaluation(folder: &Path, size: Size, mixture: &Mixture) {
    let mut places = Vec::new();
    for place in 0..size.placements {
        let copy = |(_, _, component): (_, _, &Arc<Component>)| Arc::new(Component::clone(component));
        let copies: Vec<_> = mixture.iter().map(copy).collect();
        let private = Mixture::new(0, copies.chunks(size.components).map(<[_]>::to_vec).collect());
        let path = folder.join(format!("placement-{place}"));
        let _shared = SharedMixture::create(&path, mixture, 1).expect("room in /dev/shm");
        let lent = MixtureReader::open(&path, 0).and_then(|mut reader| reader.pin(0)).expect("a sound file");
        std::fs::remove_file(path).expect("the file was just made");
        places.push((private.expect("equal dimensions"), lent));
    }
    for atoms in [108, 1000] {
        let case = Case::new(size, mixture, atoms);
        let mut work = case.work();
        let (mut private, mut shared, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
        for round in 0..120_000 / atoms / size.placements {
            for (place, (own, lent)) in places.iter().enumerate() {
                let [first, second] = if (round + place) % 2 == 0 { [own, &**lent] } else { [lent, own] };
                let times = [work(first), work(second)];
                let [a, b] = if (round + place) % 2 == 0 { times } else { [times[1], times[0]] };
                // The first round loads the pages.
                if round > 0 {
                    private.push(a);
                    shared.push(b);
                    ratios.push(b / a);
                }
            }
        }
        println!(
            "  {atoms} atoms: private {:.3} ms, shared {:.3} ms (medians of {}); median ratio of pairs {:.3}",
            median(&mut private) * 1e3,
            median(&mut shared) * 1e3,
            ratios.len(),
            median(&mut ratios)
        );
    }
}

/// Atoms near the components of the mixture.
struct Case {
    elements: Vec<usize>,
    features: Vec<f64>,
}

impl Case {
    fn new(size: Size, mixture: &Mixture, atoms: usize) -> Self {
        let mut random = Random(2);
        // An alloy of at most five elements, spread over the table.
        let element = |atom: usize| (atom % 5 * size.elements / 5).min(size.elements - 1);
        let elements: Vec<usize> = (0..atoms).map(element).collect();
        let features = elements.iter().enumerate().flat_map(|(atom, &element)| {
            let component = mixture.component(element, atom / 5 % size.components).expect("a place");
            component.centroid().iter().map(|z| z + 0.1 * random.next()).collect::<Vec<f64>>()
        });
        Self { features: features.collect(), elements }
    }

    /// Evaluates with gradient and returns the time, s.
    fn work(&self) -> impl FnMut(&Mixture) -> f64 {
        let (mut grades, mut gradient) = (Grades::default(), vec![0.0; self.features.len()]);
        move |mixture| {
            let start = now();
            let done = grades.evaluate(mixture, &self.elements, &self.features, Some(&mut gradient));
            done.expect("finite numbers");
            black_box((&grades, &gradient));
            (now() - start) as f64 / 1e9
        }
    }
}

fn median(numbers: &mut [f64]) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers[numbers.len() / 2]
}

/// A new component, from the start of `publish` until the last of 16 processes has pinned the version and graded an
/// atom with it. Each process is woken through its pipe, as by a message.
fn visibility(path: &Path, size: Size, mut mixture: Arc<Mixture>) {
    let mut shared = SharedMixture::create(path, &mixture, READERS).expect("room in /dev/shm");
    let mut readers: Vec<Child> = (0..READERS).map(|number| start(path, number)).collect();
    let (mut random, mut seen) = (Random(3), [const { Vec::new() }; 4]);
    for repetition in 0..400 {
        let place = repetition * 7 % (size.elements * size.components);
        let (element, slot) = (place / size.components, place % size.components);
        let component = component(&mut random, size.dimension);
        let next = mixture.with_changes(&[ChangedComponent { element, slot, component }]);
        mixture = Arc::new(next.expect("the same shape"));

        let start = now();
        shared.publish(&mixture).expect("room in /dev/shm");
        let published = now();
        let message = [mixture.version(), element as u64, slot as u64].map(u64::to_le_bytes).concat();
        for reader in &mut readers {
            let pipe = reader.stdin.as_mut().expect("piped");
            pipe.write_all(&message).expect("a living reader");
        }
        let answers: Vec<[u64; 3]> = readers.iter_mut().map(answer).collect();
        let last = |which: usize| answers.iter().map(|answer| answer[which]).max().unwrap_or(0);
        if repetition >= 20 {
            let times = [published - start, last(1), last(2), last(0) - start];
            seen.iter_mut().zip(times).for_each(|(seen, time)| seen.push(time as f64 / 1e3));
        }
    }
    let names = ["publish", "slowest pin", "slowest evaluation", "seen by all"];
    for (name, times) in names.iter().zip(&mut seen) {
        let (median, worst) = (median(times), times.last().copied().unwrap_or(0.0));
        println!("  {name}: median {median:.0} µs, worst {worst:.0} µs of {}", times.len());
    }
    for mut reader in readers {
        drop(reader.stdin.take());
        reader.wait().expect("a child");
    }
}

fn start(path: &Path, number: u32) -> Child {
    let program: PathBuf = std::env::current_exe().expect("the path of this program");
    let mut command = Command::new(program);
    command.arg("reader").arg(path).arg(number.to_string()).stdin(Stdio::piped()).stdout(Stdio::piped());
    command.spawn().expect("a process")
}

/// End of the evaluation, duration of the pin, duration of the evaluation, ns.
fn answer(reader: &mut Child) -> [u64; 3] {
    let mut bytes = [[0; 8]; 3];
    let pipe = reader.stdout.as_mut().expect("piped");
    pipe.read_exact(bytes.as_flattened_mut()).expect("a living reader");
    bytes.map(u64::from_le_bytes)
}

/// The reader's process of [`visibility`].
fn read(path: &Path, number: u32) {
    let mut reader = MixtureReader::open(path, number).expect("a sound file");
    let (mut input, mut output) = (std::io::stdin(), std::io::stdout());
    let (mut grades, mut features, mut message) = (Grades::default(), Vec::new(), [[0; 8]; 3]);
    drop(reader.pin(0));
    while input.read_exact(message.as_flattened_mut()).is_ok() {
        let [version, element, slot] = message.map(u64::from_le_bytes);
        let (element, slot) = (element as usize, slot as usize);
        let start = now();
        let mixture = reader.pin(version).expect("a promised version");
        let pinned = now();
        let centroid = mixture.component(element, slot).expect("a place").centroid();
        features.clear();
        features.extend(centroid.iter().map(|z| z + 0.01));
        let mut gradient = vec![0.0; features.len()];
        grades.evaluate(&mixture, &[element], &features, Some(&mut gradient)).expect("finite numbers");
        assert_eq!(grades.component, [slot]);
        let end = now();
        let answer = [end, pinned - start, end - pinned].map(u64::to_le_bytes).concat();
        output.write_all(&answer).and_then(|()| output.flush()).expect("a living parent");
    }
}
