//! Calculations: processes of their own, which outlive the labeller that started them.

use dft::FailureClass;

use super::event::Event;
use super::fault::Time;
use super::random::Random;
use super::world::World;

/// A calculation.
#[derive(Clone, Debug)]
pub struct Calculation {
    pub job: i64,
    pub state: CalculationState,
    /// What it will have computed.
    pub result: CalculationResult,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CalculationState {
    Running,
    Ended,
    /// Nothing is left of it.
    Gone,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CalculationResult {
    Label(f64),
    Failure(FailureClass),
}

impl CalculationResult {
    /// The same for each calculation of a job, in campaigns in which versions of the potential follow from labels.
    fn of_job(job: i64) -> Self {
        if job % 6 == 4 { Self::Failure(FailureClass::NotConverged) } else { Self::Label(-job as f64) }
    }

    fn draw(random: &mut Random, job: i64) -> Self {
        match random.below(20) {
            0..3 => Self::Failure(FailureClass::NotConverged),
            3 => Self::Failure(FailureClass::NodeFailure),
            _ => Self::Label(-job as f64 - random.below(100) as f64 / 1e3),
        }
    }
}

impl World {
    /// Starts a calculation for a job.
    pub fn start_calculation(&mut self, id: &str, job: i64) {
        let running = |other: &&Calculation| other.job == job && other.state == CalculationState::Running;
        if let Some(other) = self.calculations.values().find(running)
            && !self.handled.contains(&job)
        {
            let other = other.job;
            self.fail(format!("two calculations of job {other} run at the same time"));
        }
        let result = match self.scenario.has_fixed_labels() {
            true => CalculationResult::of_job(job),
            false => CalculationResult::draw(&mut self.random, job),
        };
        let time: Time = self.random.between(3_000, 15_000);
        let calculation = Calculation { job, state: CalculationState::Running, result };
        self.calculations.insert(id.to_owned(), calculation);
        self.tell(format!("calculation {id} begins"));
        self.after(time, Event::CalculationEnds(id.to_owned()));
    }

    pub fn calculation_ends(&mut self, id: &str) {
        let Some(calculation) = self.calculations.get_mut(id) else { return };
        if calculation.state != CalculationState::Running {
            return;
        }
        calculation.state = CalculationState::Ended;
        self.wake_labellers_of(id);
    }

    /// Ends a calculation. Its result is not read.
    pub fn remove_calculation(&mut self, id: &str) {
        if let Some(calculation) = self.calculations.get_mut(id) {
            calculation.state = CalculationState::Gone;
        }
    }

    pub fn kill_calculation(&mut self) {
        let running =
            |(_, calculation): &(&String, &Calculation)| calculation.state == CalculationState::Running;
        let found = self.calculations.iter().find(running).map(|(id, _)| id.clone());
        if let Some(id) = found {
            self.remove_calculation(&id);
            self.tell(format!("calculation {id} was killed"));
            self.wake_labellers_of(&id);
        }
    }
}
