//! What must hold of assignments when walkers begin them.

use std::collections::BTreeMap;
use std::sync::Arc;

use calm::Mixture;
use wire::WalkId;
use wire::messages::Assignment;
use wire::transport::WorkItem;

use super::agent::AgentKey;
use super::world::World;

/// The mixtures with which each assignment was sent: several, if it was sent again after its walker was lost.
#[derive(Default)]
pub struct SentMixtures(BTreeMap<(WalkId, u64), Vec<Arc<Mixture>>>);

impl SentMixtures {
    pub fn add(&mut self, WorkItem { assignment, mixture }: &WorkItem) {
        self.0.entry((assignment.walk, assignment.number)).or_default().push(Arc::clone(mixture));
    }

    /// The mixture of this version with which the assignment was sent.
    fn find(&self, assignment: &Assignment, version: u64) -> Option<&Mixture> {
        let sent = self.0.get(&(assignment.walk, assignment.number))?;
        sent.iter().find(|mixture| mixture.version() == version).map(Arc::as_ref)
    }
}

impl World {
    /// A walker begins an assignment: with a mixture with which it was sent, bit by bit.
    pub fn check_mixture_of(&mut self, who: &str, assignment: &Assignment, mixture: &Mixture) {
        let (walk, number, version) = (assignment.walk, assignment.number, mixture.version());
        match self.known.sent.find(assignment, version) {
            None => self.fail(format!(
                "{who} begins assignment {number} of walk {walk} with version {version} of the mixture, with which it was not sent"
            )),
            Some(sent) if !grade_alike(sent, mixture) => {
                self.fail(format!("{who} has other components of version {version} of the mixture than were sent"));
            }
            Some(_) => {}
        }
    }

    /// A walker of an agent begins an assignment: no other walker of that registration has it. One that the agent got
    /// under an earlier registration may be dealt to it again, since the orchestrator took the agent for dead.
    pub fn check_dealt_once(&mut self, key: AgentKey, walker: u32) {
        let Some(works) = self.agents.get(&key.agent).map(|agent| agent.works()) else { return };
        let Some(own) = works.iter().find(|work| work.walker == walker) else { return };
        let same = |work: &&AgentWork| {
            work.walker != walker && (work.walk, work.registration) == (own.walk, own.registration)
        };
        if let Some(other) = works.iter().find(same) {
            let (agent, walk, other) = (key.agent, own.walk, other.walker);
            self.fail(format!(
                "walkers {walker} and {other} of agent {agent} work on walk {walk} at the same time"
            ));
        }
    }
}

/// What a walker of an agent works on.
pub struct AgentWork {
    pub walker: u32,
    /// The registration of the agent, counted from 1.
    pub registration: u64,
    pub walk: WalkId,
}

/// Whether every structure has the same grades by both, bit by bit. Walkers have no statistics of components.
fn grade_alike(a: &Mixture, b: &Mixture) -> bool {
    let mut pairs = a.iter().zip(b.iter());
    a.iter().count() == b.iter().count()
        && pairs.all(|((element, slot, a), (other_element, other_slot, b))| {
            (element, slot) == (other_element, other_slot)
                && (a.centroid(), a.inverse()) == (b.centroid(), b.inverse())
                && a.threshold().to_bits() == b.threshold().to_bits()
        })
}
