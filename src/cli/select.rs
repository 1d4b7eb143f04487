//! `calmwalk select`

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::extxyz::write_frame;
use calm::Projection;
use calm::rules::Positive;
use calm::selection::Window;
use serde_json::{Value, json};

use super::calm::load;
use super::{CommandError, ExitStatus, campaign_location};
use crate::atomic_file::{AtomicFile, cannot_write, refuse_to_replace};
use crate::loaded_model::LoadedModel;
use crate::output::{TextTable, count, decimals, print, print_json, print_stderr};
use crate::selection::{
    CampaignCandidates, CandidateChoice, FeatureIdentity, GradedPool, Pick, Picks, PoolFiles, PoolGrading,
    Rules, Strategy, StrategyQuota, StructureSource, frames, pick,
};
use crate::signals::stop_token;
use crate::structure_files::StructureReadingArgs;

/// Select structures for labelling from a pool
///
/// Grades the pool, then applies the strategies in order; each picks from the structures that are left:
///
/// greedy: picks the structure with the largest γ, then updates a copy of the mixture with it (additive update). Ends when no γ is above
/// --min-gamma, or after N structures.
///
/// fps (fps-extrap): finds the atom within the grade window that is farthest from the picked ones, in whitened features, and picks its
/// structure. Starts from the structures that earlier strategies picked. fps-all: uses all atoms, in plain features.
///
/// d-optimal: picks the structure whose atoms within the window raise log det Σ zzᵀ most, summed over the elements (z: features). Starts
/// from the training data, which weigh as much as one atom of each element, and from the structures that earlier strategies picked.
///
/// random (random-all): uniformly at random. random-extrap: among structures with an atom within the window.
///
/// Copies each picked frame and adds selection_strategy, selection_rank (from 1) and gamma_max (at the pick). Frames of files also get
/// source_file and source_frame (from 0), candidates of campaigns also campaign, candidate_id and fate. `calmwalk import --queue`
/// queues them in a campaign for labelling. Leaves out structures that cannot be graded (an element that the model does not have, atoms
/// closer than 0.4 Å), with a warning. See docs/select.md.
#[derive(Debug, clap::Args)]
pub struct SelectArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// CALM artifact (gmm_artifacts.npz); greedy and d-optimal need its statistics [default: mixture in the model file]
    #[arg(long, value_name = "CALM.npz")]
    artifact: Option<PathBuf>,
    /// Structures: extended XYZ (.extxyz, .xyz), POSCAR (.poscar, .vasp, POSCAR*, CONTCAR*) or text dumps of LAMMPS (.dump,
    /// .lammpstrj, dump.*), each also with .gz or .zst
    #[arg(value_name = "POOL", required_unless_present = "campaign")]
    pool: Vec<PathBuf>,
    #[command(flatten)]
    reading: StructureReadingArgs,
    /// Add the candidates of a campaign's biased walks to the pool: its directory or the postgres:// URL of its store; may be repeated.
    /// Uses stored features where the store has them
    #[arg(long, value_name = "DIR")]
    campaign: Vec<PathBuf>,
    /// Take only declined candidates from campaigns
    #[arg(long, requires = "campaign")]
    declined: bool,
    /// Leave out candidates of campaigns whose features are not stored or belong to another model or projection [default: evaluate the
    /// model on them]
    #[arg(long, requires = "campaign")]
    no_evaluation: bool,
    /// Strategies in order, each with its number of structures: greedy, fps, fps-all, d-optimal, random, random-extrap
    #[arg(long, value_name = "NAME[:N]", num_args = 1.., value_delimiter = ',', default_value = "greedy")]
    strategy: Vec<StrategyQuota>,
    /// Number of structures of a single strategy [default for greedy: all with γ above --min-gamma]
    #[arg(long, short = 'n', value_name = "N")]
    number: Option<usize>,
    /// Lower limit of the grade window: atoms with γ above it count
    #[arg(long, value_name = "GAMMA", default_value_t = 1.0)]
    min_gamma: f64,
    /// Upper limit of the grade window: atoms with γ above it are left out, such as those of broken structures [default: none]
    #[arg(long, value_name = "GAMMA")]
    max_gamma: Option<f64>,
    /// Greedy: γ that an update must reach for a picked structure
    #[arg(long, value_name = "GAMMA", default_value_t = 1.25)]
    update_target: f64,
    /// Minimum number of atoms of each element in the selection [default: D + 1, the feature dimension plus one; greedy alone: none]
    ///
    /// If an element has fewer, structures with many of its atoms replace the last picks of the strategies other than greedy.
    #[arg(long, value_name = "ATOMS")]
    min_per_element: Option<u64>,
    /// No minimum number of atoms of each element
    #[arg(long, conflicts_with = "min_per_element")]
    no_element_floors: bool,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 42)]
    rng_seed: u64,
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Memory for features, GB; a temporary file beside the output holds the rest
    #[arg(long, value_name = "GB", default_value_t = 4.0)]
    memory: f64,
    /// File for the selected structures, extended XYZ; an existing file is replaced at the end
    #[arg(long, short, value_name = "OUT.extxyz")]
    output: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl SelectArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (parts, window, target) = (self.parts()?, self.window()?, self.target()?);
        let files = self.reading.files(&self.pool)?;
        let inputs = files.paths().map(|path| (path, "a file of the pool"));
        let own = [(self.model.as_path(), "the model")].into_iter();
        let own = own.chain(self.artifact.as_deref().map(|path| (path, "the artifact")));
        refuse_to_replace(&self.output, own.chain(inputs))?;
        // Errors in paths are found before hours of work.
        AtomicFile::create(&self.output).map(drop)?;
        let (features, artifact) = load(&self.model, self.artifact.as_deref())?;
        let projection = features.projection().unwrap_or(artifact.projection);
        let (model, mixture) = (features.model, Arc::new(artifact.mixture));

        let needed = parts
            .iter()
            .find_map(|StrategyQuota { strategy, .. }| Some((strategy, strategy.use_of_statistics()?)));
        if let Some((strategy, uses)) = needed
            && !mixture.can_be_updated()
        {
            return Err(CommandError::Input(format!(
                "{}: the mixture has no statistics, which {} {uses}: use --artifact with the gmm_artifacts.npz of this model",
                self.model.display(),
                strategy.name()
            )));
        }
        let mut pool = PoolFiles { files, campaigns: self.campaigns(projection)? };
        let grading = PoolGrading {
            model: model.shared(),
            mixture: Arc::clone(&mixture),
            window,
            all_atoms: parts.iter().any(|part| part.strategy == Strategy::FarthestPointsAll),
            memory: self.memory_bytes()?,
            directory: self.directory(),
            threads: self.threads.map_or_else(all_cores, usize::from),
            stop: stop_token()?,
        };
        let interrupted = || {
            print_stderr("stopped; nothing was written");
            Ok(ExitStatus::Interrupted)
        };
        let Some(graded) = grading.run(&mut pool)? else { return interrupted() };
        let floor = self.floor(&parts, mixture.dimension());
        let rules = Rules { parts, update_target: target, floor, seed: self.rng_seed };
        let Some(picks) = pick(&graded, &mixture, &rules, &grading.stop)? else { return interrupted() };
        self.write(&pool, &graded, &picks.picks)?;
        let report = SelectionReport {
            command: &self,
            model: &model,
            files: &pool,
            pool: &graded,
            rules: &rules,
            picks: &picks,
        };
        report.print()?;
        Ok(ExitStatus::Done)
    }

    /// The strategies with the numbers of structures that they pick.
    fn parts(&self) -> Result<Vec<StrategyQuota>, CommandError> {
        let mut parts = self.strategy.clone();
        match (parts.as_mut_slice(), self.number) {
            (_, Some(0)) => return Err(CommandError::Input("-n 0: expected a number above 0".to_owned())),
            ([part], Some(number)) if part.number.is_none() => part.number = Some(number),
            (_, Some(_)) => {
                let message = "-n is for a single strategy without a number; give each its own, as in greedy:200 fps:25";
                return Err(CommandError::Input(message.to_owned()));
            }
            (_, None) => (),
        }
        let without = parts.iter().find(|part| part.number.is_none() && part.strategy != Strategy::Greedy);
        match without {
            None => Ok(parts),
            Some(part) => {
                let name = part.strategy.name();
                Err(CommandError::Input(format!(
                    "--strategy {name}: expected a number of structures, as in {name}:25, or -n"
                )))
            }
        }
    }

    fn window(&self) -> Result<Window, CommandError> {
        let window = Window { above: self.min_gamma, up_to: self.max_gamma.unwrap_or(f64::INFINITY) };
        if window.above >= 0.0 && window.above < window.up_to {
            return Ok(window);
        }
        let Window { above, up_to } = window;
        Err(CommandError::Input(format!(
            "--min-gamma {above}, --max-gamma {up_to}: expected a lower limit of 0 or more that is below the upper one"
        )))
    }

    fn target(&self) -> Result<Positive, CommandError> {
        Positive::try_from(self.update_target)
            .map_err(|error| CommandError::Input(format!("--update-target: {error}")))
    }

    fn memory_bytes(&self) -> Result<usize, CommandError> {
        if self.memory.is_finite() && self.memory >= 0.0 {
            return Ok((1e9 * self.memory) as usize);
        }
        Err(CommandError::Input(format!("--memory {}: expected a number of GB, 0 or more", self.memory)))
    }

    /// That of the output.
    fn directory(&self) -> PathBuf {
        let parent = self.output.parent().filter(|parent| !parent.as_os_str().is_empty());
        parent.unwrap_or(Path::new(".")).to_owned()
    }

    fn floor(&self, parts: &[StrategyQuota], dimension: usize) -> Option<u64> {
        let greedy_only = parts.iter().all(|part| part.strategy == Strategy::Greedy);
        match self.min_per_element {
            _ if self.no_element_floors => None,
            None if greedy_only => None,
            floor => Some(floor.unwrap_or(dimension as u64 + 1)),
        }
    }

    /// `projection` is that of the features.
    fn campaigns(&self, projection: Projection) -> Result<Vec<CampaignCandidates>, CommandError> {
        if self.campaign.is_empty() {
            return Ok(Vec::new());
        }
        let choice = CandidateChoice {
            dimension: projection.feature_dimension,
            features: FeatureIdentity::new(&self.model, self.artifact.as_deref(), projection)?,
            declined_only: self.declined,
            no_evaluation: self.no_evaluation,
        };
        let campaigns = self.campaign.iter().zip(0..);
        let open = |(path, number): (&PathBuf, u32)| {
            CampaignCandidates::open(&campaign_location::parse(path)?, number, choice.clone())
        };
        campaigns.map(open).collect()
    }

    fn write(&self, files: &PoolFiles, pool: &GradedPool, picks: &[Pick]) -> Result<(), CommandError> {
        let mut output = AtomicFile::create(&self.output)?;
        for frame in frames(files, pool, picks)? {
            write_frame(&mut output, &frame).map_err(|error| cannot_write(&self.output, error))?;
        }
        output.finish()
    }
}

fn all_cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| cores.get())
}

/// What is said of a selection.
struct SelectionReport<'a> {
    command: &'a SelectArgs,
    model: &'a LoadedModel,
    files: &'a PoolFiles,
    pool: &'a GradedPool,
    rules: &'a Rules,
    picks: &'a Picks,
}

/// An element of the pool.
struct ElementSelection {
    symbol: String,
    selected: u64,
    pool: u64,
    is_short: bool,
}

impl SelectionReport<'_> {
    fn print(&self) -> Result<(), CommandError> {
        if self.command.json { print_json(&self.json()) } else { self.print_tables() }
    }

    /// The strategies in order, `floor` last, with their picks.
    fn strategies(&self) -> Vec<(&'static str, Vec<&Pick>)> {
        let mut names: Vec<&'static str> = self.rules.parts.iter().map(|part| part.strategy.name()).collect();
        names.push("floor");
        let mut seen = Vec::new();
        names.retain(|name| {
            !seen.contains(name) && {
                seen.push(*name);
                true
            }
        });
        let of = |name: &'static str| {
            (name, self.picks.picks.iter().filter(|pick| pick.strategy == name).collect())
        };
        names
            .into_iter()
            .map(of)
            .filter(|(name, picks): &(_, Vec<_>)| *name != "floor" || !picks.is_empty())
            .collect()
    }

    fn elements(&self) -> Vec<ElementSelection> {
        let symbols = self.model.elements().iter().enumerate();
        let all = 0..self.pool.structures.len();
        let elements = symbols.map(|(index, species)| ElementSelection {
            symbol: species.symbol().to_owned(),
            selected: self.picks.picks.iter().map(|pick| self.pool.atoms(pick.structure, index)).sum(),
            pool: all.clone().map(|structure| self.pool.atoms(structure, index)).sum(),
            is_short: self.picks.short.contains(&index),
        });
        elements.filter(|element| element.pool > 0).collect()
    }

    /// Candidates that were left out because the model would have been evaluated on them.
    fn left_out(&self) -> u64 {
        self.files.campaigns.iter().map(|campaign| campaign.left_out).sum()
    }

    fn atoms<'p>(&self, picks: impl IntoIterator<Item = &'p &'p Pick>) -> u64 {
        picks.into_iter().map(|pick| self.pool.total_atoms(pick.structure)).sum()
    }

    fn strategy_table(&self) -> TextTable {
        let mut table = TextTable::new(&["strategy", ">structures", ">atoms", ">largest γ", ">smallest γ"]);
        for (name, picks) in self.strategies() {
            let gamma = || picks.iter().map(|pick| pick.gamma_max);
            table.push(vec![
                name.to_owned(),
                picks.len().to_string(),
                self.atoms(&picks).to_string(),
                decimals(gamma().reduce(f64::max), 2),
                decimals(gamma().reduce(f64::min), 2),
            ]);
        }
        table
    }

    fn print_tables(&self) -> Result<(), CommandError> {
        let mut elements = TextTable::new(&["element", ">atoms selected", ">of the pool"]);
        for ElementSelection { symbol, selected, pool, .. } in self.elements() {
            elements.push(vec![symbol, selected.to_string(), pool.to_string()]);
        }
        let (total, evaluated) = (self.pool.structures.len() as u64, self.pool.evaluated);
        let stored = total - evaluated;
        print(|out| {
            self.strategy_table().write(out)?;
            writeln!(out)?;
            elements.write(out)?;
            writeln!(out)?;
            self.write_what_is_left(out)?;
            if stored > 0 {
                writeln!(
                    out,
                    "features of {} from stores, of {} computed",
                    count(stored, "structure"),
                    count(evaluated, "structure")
                )?;
            }
            if self.command.no_evaluation {
                let left_out = count(self.left_out(), "candidate");
                writeln!(out, "left out {left_out} without stored features of this model")?;
            }
            writeln!(
                out,
                "selected {} of {}; wrote {}",
                count(self.picks.picks.len(), "structure"),
                total,
                self.command.output.display()
            )
        })
    }

    /// The grades that are left, and the elements with too few atoms.
    fn write_what_is_left(&self, out: &mut dyn Write) -> io::Result<()> {
        let window = self.pool.pool.window();
        let learnt = "under the mixture updated with what was selected";
        match self.picks.gamma_left {
            Some(left) if left > window.above => writeln!(out, "largest γ left: {left:.3}, {learnt}")?,
            Some(_) => writeln!(out, "no γ above {} is left, {learnt}", window.above)?,
            None => (),
        }
        for element in self.elements().iter().filter(|element| element.is_short) {
            let floor = self.rules.floor.unwrap_or_default();
            writeln!(
                out,
                "{}: only {} atoms; {floor} do not fit this number of structures",
                element.symbol, element.selected
            )?;
        }
        Ok(())
    }

    fn json(&self) -> Value {
        let pool = &self.pool.pool;
        let within = (0..pool.len()).filter(|s| pool.window_atoms_of(*s).next().is_some()).count();
        let atoms_within = pool.atoms().iter().filter(|atom| pool.window().has(atom.gamma)).count();
        let strategies = self.strategies().into_iter().map(|(name, picks)| {
            json!({ "strategy": name, "structures": picks.len(), "atoms": self.atoms(&picks) })
        });
        let elements = self.elements().into_iter().map(|ElementSelection { symbol, selected, pool, is_short }| {
            json!({ "element": symbol, "selected_atoms": selected, "pool_atoms": pool, "short": is_short })
        });
        let picks = self.picks.picks.iter().zip(1..).map(|(pick, rank)| self.pick(pick, rank));
        json!({
            "pool": {
                "structures": pool.len(),
                "structures_within_window": within,
                "atoms_within_window": atoms_within,
                "features_computed": self.pool.evaluated,
                "features_from_stores": pool.len() as u64 - self.pool.evaluated,
                "candidates_left_out": self.left_out(),
                "ungraded": self.pool.left_out.count(),
            },
            "strategies": strategies.collect::<Vec<_>>(),
            "elements": elements.collect::<Vec<_>>(),
            "floor": self.rules.floor,
            "gamma_left": self.picks.gamma_left,
            "picks": picks.collect::<Vec<_>>(),
        })
    }

    fn pick(&self, pick: &Pick, rank: u64) -> Value {
        let mut value = json!({ "rank": rank, "strategy": pick.strategy, "gamma_max": pick.gamma_max });
        match self.pool.structures[pick.structure].source {
            StructureSource::File { file, frame } => {
                value["source_file"] = json!(self.files.files.files[file as usize].path.to_string_lossy());
                value["source_frame"] = json!(frame);
            }
            StructureSource::Candidate { campaign, decision } => {
                value["campaign"] = json!(self.files.campaigns[campaign as usize].id);
                value["decision"] = json!(decision);
            }
        }
        value
    }
}
