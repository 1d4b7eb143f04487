//! Checks the content of long columns: structures, candidates, labels, JSON texts, packed directories, versions of the
//! potential.

use wire::{CandidateBlock, ContentHash};

use super::archives::ArchiveRow;
use super::finding::Finding;
use super::versions;
use crate::checksum::{
    CANDIDATE, CheckedColumn, CheckedTable, DECISION, LABEL, LONG_COLUMNS, Names, PROTOCOL, STRUCTURE,
};
use crate::database::{FromRow, SqlRow, Transaction, from_columns, query};
use crate::encoding::decode_structure;
use crate::error::{Result, StoreError};
use crate::numbers::decode_numbers;
use crate::tables::checksums;
use crate::tables::label_row::decode_label;
use crate::tables::versions::expected_files;

/// Rows read at a time: a row of a large structure has megabytes.
const PAGE: u32 = 16;
/// Number of findings of a kind that are listed one by one.
const MAX_LISTED: usize = 5;

const STRUCTURES: &str =
    "SELECT number AS place, structure.* FROM structure WHERE number > $1 ORDER BY number LIMIT $2";

const CANDIDATES: &str =
    "SELECT candidate_data.decision AS place, block, features, selector_grades, original_grades, candidate.*
    FROM candidate_data JOIN candidate ON candidate.decision = candidate_data.decision
    WHERE candidate_data.decision > $1 ORDER BY candidate_data.decision LIMIT $2";

const LABELS: &str = "SELECT label.number AS place, atoms, label.*
    FROM label JOIN structure ON structure.number = label.structure
    WHERE label.number > $1 ORDER BY label.number LIMIT $2";

const DECISIONS: &str = "SELECT sequence AS place, detail AS text, decision.* FROM decision WHERE sequence > $1 ORDER BY sequence LIMIT $2";

const PROTOCOLS: &str = "SELECT number AS place, settings AS text, protocol.* FROM protocol WHERE number > $1 ORDER BY number LIMIT $2";

const ROWS: &str = "SELECT (SELECT count(*) FROM structure) + (SELECT count(*) FROM candidate_data)
    + (SELECT count(*) FROM label) + (SELECT count(*) FROM decision) + (SELECT count(*) FROM protocol)
    + (SELECT count(*) FROM archive)";

struct StructureContent {
    hash: Vec<u8>,
    data: Vec<u8>,
}

struct CandidateContent {
    id: String,
    content: Vec<u8>,
    block: Vec<u8>,
    features: Option<Vec<u8>>,
    selector_grades: Option<Vec<u8>>,
    original_grades: Option<Vec<u8>>,
}

struct LabelContent {
    atoms: u64,
    energy: f64,
    forces: Vec<u8>,
    stress: Option<Vec<u8>>,
    details: Option<String>,
}

struct TextContent {
    text: String,
}

from_columns!(StructureContent { hash, data });
from_columns!(CandidateContent { id, content, block, features, selector_grades, original_grades });
from_columns!(LabelContent { atoms, energy, forces, stress, details });
from_columns!(TextContent { text });

/// A row whose content can be checked.
trait CheckedContent: FromRow {
    /// What is wrong with it.
    fn fault(&self) -> Option<String>;
}

/// The table of the rows, and its long columns that have checksums of their own.
type Checked = (&'static CheckedTable, &'static [&'static CheckedColumn]);

/// The fault of a row: invalid content or a wrong checksum.
fn fault<C: CheckedContent>(row: &SqlRow, (table, columns): Checked) -> Option<String> {
    let content = match C::from_row(row) {
        Ok(content) => content.fault(),
        Err(error) => Some(error.to_string()),
    };
    let verify = || {
        let columns = columns.iter().map(|column| column.verify(row));
        let mut verified = std::iter::once(table.verify(row, Names::Plain)).chain(columns);
        verified.find_map(Result::err).map(|error| match error {
            StoreError::Damaged { what, reason } => format!("{what}: {reason}"),
            error => error.to_string(),
        })
    };
    content.or_else(verify)
}

/// Checks rows and collects findings.
pub(super) struct Contents<'a> {
    transaction: &'a mut Transaction,
    on_progress: &'a mut dyn FnMut(u64, u64),
    read: u64,
    all: u64,
    findings: Vec<Finding>,
}

impl<'a> Contents<'a> {
    pub async fn check(
        transaction: &'a mut Transaction,
        on_progress: &'a mut dyn FnMut(u64, u64),
    ) -> Result<Vec<Finding>> {
        let rows: u64 = query(ROWS).fetch_one(&mut *transaction).await?;
        let all = rows + versions::count_files(transaction).await?;
        let mut contents = Self { transaction, on_progress, read: 0, all, findings: Vec::new() };
        contents.table::<StructureContent>((&STRUCTURE, &[]), STRUCTURES).await?;
        contents.table::<CandidateContent>((&CANDIDATE, &LONG_COLUMNS), CANDIDATES).await?;
        contents.table::<LabelContent>((&LABEL, &[]), LABELS).await?;
        contents.table::<TextContent>((&DECISION, &[]), DECISIONS).await?;
        contents.table::<TextContent>((&PROTOCOL, &[]), PROTOCOLS).await?;
        contents.archives().await?;
        contents.versions().await?;
        let others = checksums::verify_others(contents.transaction).await?;
        contents.found(others);
        Ok(contents.findings)
    }

    async fn table<C: CheckedContent>(&mut self, checked: Checked, sql: &'static str) -> Result<()> {
        let (mut after, mut faults, what) = (0, Vec::new(), checked.0.name);
        loop {
            let page = query(sql).bind(after).bind(PAGE).rows(&mut *self.transaction).await?;
            let Some(last) = page.last() else { break };
            after = last.get("place")?;
            self.have_read(page.len() as u64);
            for row in &page {
                if let Some(fault) = fault::<C>(row, checked) {
                    faults.push(format!("{what} {}: {fault}", row.get::<i64>("place")?));
                }
            }
        }
        self.found(faults);
        Ok(())
    }

    /// One at a time: each may be as large as the work directory of a calculation.
    async fn archives(&mut self) -> Result<()> {
        let (mut last, mut faults) = ((0, 0), Vec::new());
        while let Some(packed) = ArchiveRow::after(self.transaction, last.0, last.1).await? {
            last = (packed.job, packed.attempt);
            self.have_read(1);
            let fault = packed.fault();
            faults.extend(fault.map(|fault| format!("files of job {}, attempt {}: {fault}", last.0, last.1)));
        }
        self.found(faults);
        Ok(())
    }

    /// Versions of the potential and their files, one file at a time.
    async fn versions(&mut self) -> Result<()> {
        let mut faults = Vec::new();
        for version in versions::registered(self.transaction, &mut faults).await? {
            for file in expected_files(&version) {
                faults.extend(versions::file_fault(self.transaction, version.number, file).await?);
                self.have_read(1);
            }
        }
        self.found(faults);
        Ok(())
    }

    fn have_read(&mut self, rows: u64) {
        self.read += rows;
        (self.on_progress)(self.read, self.all);
    }

    fn found(&mut self, faults: Vec<String>) {
        let then = "its content is damaged; restore the campaign from a backup";
        if faults.len() > MAX_LISTED {
            let more = format!("{} more rows of the same table have such faults", faults.len() - MAX_LISTED);
            self.findings.push(Finding { what: more, then });
        }
        self.findings.extend(faults.into_iter().take(MAX_LISTED).map(|what| Finding { what, then }));
    }
}

impl CheckedContent for StructureContent {
    fn fault(&self) -> Option<String> {
        decode_structure(&self.data, &self.hash).err().map(|_| "it does not match its hash".to_owned())
    }
}

impl CheckedContent for CandidateContent {
    fn fault(&self) -> Option<String> {
        let block = match CandidateBlock::from_bytes(&self.block) {
            Ok(block) => block,
            Err(error) => return Some(error.to_string()),
        };
        let view = block.view();
        if view.id().to_string() != self.id || view.id().content.0 != *self.content {
            return Some(format!("its block is that of {}", view.id()));
        }
        if ContentHash::from_structure(&view.structure()) != view.id().content {
            return Some("its structure does not match its hash".to_owned());
        }
        let n = view.numbers.len();
        let numbers =
            |what: &str, bytes: &Option<Vec<u8>>, fits: fn(usize, usize) -> bool| match decode_numbers(
                bytes.as_deref()?,
            ) {
                Ok(numbers) if fits(numbers.len(), n) => None,
                Ok(numbers) => Some(format!("{} {what} for {n} atoms", numbers.len())),
                Err(error) => Some(format!("its {what}: {error}")),
            };
        let grades = |count, atoms| count == 2 * atoms;
        numbers("features", &self.features, |count, atoms| atoms > 0 && count % atoms == 0)
            .or_else(|| numbers("grades of the selector", &self.selector_grades, grades))
            .or_else(|| numbers("original grades", &self.original_grades, grades))
    }
}

impl CheckedContent for LabelContent {
    fn fault(&self) -> Option<String> {
        let label =
            match decode_label(self.energy, &self.forces, self.stress.as_deref(), self.details.as_deref()) {
                Ok(label) => label,
                Err(error) => return Some(error.to_string()),
            };
        let stress = label.stress.iter().flatten();
        let finite = label.forces.iter().chain(stress).flatten().all(|x| x.is_finite());
        if label.forces.len() as u64 != self.atoms {
            return Some(format!("{} forces for {} atoms", label.forces.len(), self.atoms));
        }
        let moments = label.details.magnetic_moments.as_ref().map_or(label.forces.len(), Vec::len);
        if moments as u64 != self.atoms {
            return Some(format!("{moments} magnetic moments for {} atoms", self.atoms));
        }
        (!finite || !label.energy.is_finite()).then(|| "it has non-finite numbers".to_owned())
    }
}

impl CheckedContent for TextContent {
    fn fault(&self) -> Option<String> {
        let parsed: serde_json::Result<serde_json::Value> = serde_json::from_str(&self.text);
        parsed.err().map(|error| format!("its text is not valid JSON ({error})"))
    }
}
