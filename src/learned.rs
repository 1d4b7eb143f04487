//! What the labels of a campaign teach: how far the potential errs, whether the grade told where, and which structures got no label.

use analysis::{Bins, Completion, ForceErrors};
use atoms::cell::{norm, sub};
use store::{AtomGrades, ExportFilter, ExportSource, FinishedCandidate, Store, StoreError};
use wire::{ContentHash, Origin};

use crate::energies::{EnergyErrors, Zeros};

/// Force errors above this are large, eV/Å, as in the paper.
pub const LARGE: f64 = 1.0;

/// Rows read from the store at a time.
const PAGE: u32 = 256;
/// Atoms that ranks and quantiles come from, at most; of more a sample.
const ROOM: usize = 1 << 20;

/// Force errors by either grade of the original mixture.
#[derive(Clone, Debug)]
pub struct Grades {
    /// Labelled structures.
    pub structures: u64,
    /// By γ.
    pub gamma: ForceErrors,
    /// By γ_nbr.
    pub gamma_nbr: ForceErrors,
}

/// All of it.
#[derive(Clone, Debug)]
pub struct Learned {
    /// Of all structures.
    pub all: Grades,
    /// Of those of biased walks alone.
    pub biased: Grades,
    /// Of frames of control walks alone.
    pub control: Grades,
    /// Energy errors of all structures.
    pub energies: EnergyErrors,
    /// Labelled structures that a biased walk and a control both found, as at a step before the bias tells them apart: they stand
    /// in `all` once, and are no part of the comparison.
    pub shared: u64,
    /// Which got their labels, by the largest γ; failed ones by their names.
    pub by_gamma: Completion<String>,
    /// The same by V/V₀.
    pub by_expansion: Completion<String>,
}

/// Reads it page by page, for the labels of one protocol.
pub async fn of(store: &Store, protocol: ContentHash) -> Result<Learned, StoreError> {
    let mut learned = Learned {
        all: Grades::new(),
        biased: Grades::new(),
        control: Grades::new(),
        energies: EnergyErrors::new(Zeros::read(store, protocol).await?),
        shared: 0,
        by_gamma: Completion::new(Bins::of_grades()),
        by_expansion: Completion::new(Bins::of_expansion()),
    };
    let shared = store.structures_of_both_origins().await?;
    let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
    let mut after = None;
    loop {
        let page = store.labelled(&filter, after, PAGE).await?;
        let Some(last) = page.last() else { break };
        after = Some(last.cursor);
        for row in &page {
            let ExportSource::Candidate { origin, block, original, .. } = &row.source else { continue };
            let forces = block.view().forces;
            let errors = forces.iter().zip(&row.label.forces).map(|(model, label)| norm(sub(*model, *label)));
            let errors: Vec<_> = errors.collect();
            match (shared.contains(&block.view().id().content), *origin) {
                (false, origin) => learned.each(origin, |grades| grades.labelled(original, &errors)),
                (true, Origin::Biased) => {
                    learned.shared += 1;
                    learned.all.labelled(original, &errors);
                }
                // It was counted with the other.
                (true, Origin::Control) => continue,
            }
            learned.energies.push(&row.structure, block.view().energy(), row.label.energy);
        }
    }
    let mut after = 0;
    loop {
        let page = store.finished(protocol, after, PAGE).await?;
        let Some(last) = page.last() else { break };
        after = last.decision;
        page.iter().for_each(|candidate| learned.finished(candidate));
    }
    Ok(learned)
}

impl Learned {
    fn each(&mut self, origin: Origin, mut change: impl FnMut(&mut Grades)) {
        let of_origin = if origin == Origin::Biased { &mut self.biased } else { &mut self.control };
        [&mut self.all, of_origin].into_iter().for_each(&mut change);
    }

    fn finished(&mut self, candidate: &FinishedCandidate) {
        for (completion, value) in
            [(&mut self.by_gamma, candidate.gamma), (&mut self.by_expansion, candidate.relative_volume)]
        {
            match candidate.labelled {
                true => completion.labelled(value),
                false => completion.failed(value, candidate.candidate.clone()),
            }
        }
        if let Some(grades) = &candidate.unlabelled {
            self.each(candidate.origin, |all| all.unlabelled(grades));
        }
    }
}

impl Grades {
    fn new() -> Self {
        let errors = ForceErrors::new(Bins::of_grades(), LARGE, ROOM);
        Self { structures: 0, gamma: errors.clone(), gamma_nbr: errors }
    }

    fn labelled(&mut self, original: &AtomGrades, errors: &[f64]) {
        self.structures += 1;
        for (by, grades) in [(&mut self.gamma, &original.gamma), (&mut self.gamma_nbr, &original.gamma_nbr)] {
            grades.iter().zip(errors).for_each(|(grade, error)| by.push(*grade, *error));
        }
    }

    fn unlabelled(&mut self, original: &AtomGrades) {
        original.gamma.iter().for_each(|grade| self.gamma.push_unlabelled(*grade));
        original.gamma_nbr.iter().for_each(|grade| self.gamma_nbr.push_unlabelled(*grade));
    }
}
