//! One candidate or imported structure: its details, its atoms, and files to download.

use std::collections::BTreeMap;

use atoms::extxyz::{Column, ColumnData, Frame, FrameLabels, LabelKeys, write_frame};
use atoms::poscar::write_poscar;
use atoms::{BOND_FACTOR, Structure};
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use monitor::candidate_details;
use serde_json::json;
use store::{LabelStatus, Store, StoreError, StoredCandidate};
use wire::ContentHash;

use super::Dashboard;
use super::response::{ApiError, ApiResult, json};
use crate::wording;

/// A structure with its candidate.
struct StructureRecord {
    /// Its name.
    id: String,
    structure: Structure,
    content: ContentHash,
    /// `None` for imported structures.
    candidate: Option<StoredCandidate>,
}

/// `GET /api/candidates/ID`: what `calmwalk explain ID --json` prints.
pub async fn details(State(dashboard): State<Dashboard>, Path(id): Path<String>) -> ApiResult {
    let details = candidate_details::read(&dashboard.store, &id).await?;
    let details = wording::json::candidate(&details);
    json(&details.map_err(|error| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error))?)
}

/// `GET /api/candidates/ID/structure`: species, positions and cell (Å), and the covalent radius of each element (Å); atoms closer than
/// `bond_factor` times the sum of their radii are bonded.
pub async fn structure(State(dashboard): State<Dashboard>, Path(id): Path<String>) -> ApiResult {
    let StructureRecord { id, structure, .. } = find(&dashboard.store, &id).await?;
    let species: Vec<_> = structure.species.iter().map(|species| species.symbol()).collect();
    let radii: BTreeMap<_, _> =
        structure.species.iter().map(|species| (species.symbol(), species.covalent_radius())).collect();
    json(&json!({
        "id": id, "species": species, "positions": structure.positions, "cell": structure.cell.0,
        "periodic": structure.periodic, "radii": radii, "bond_factor": BOND_FACTOR,
    }))
}

/// `GET /api/candidates/ID/structure.extxyz`: with γ and γ_nbr of the original mixture, and the label if there is
/// one.
pub async fn extxyz(State(dashboard): State<Dashboard>, Path(id): Path<String>) -> ApiResult {
    let store = &dashboard.store;
    let found = find(store, &id).await?;
    let id = found.id.clone();
    let mut bytes = Vec::new();
    write_frame(&mut bytes, &frame(store, found).await?).map_err(unwritable)?;
    Ok(attachment(&format!("{id}.extxyz"), bytes))
}

/// `GET /api/candidates/ID/structure.poscar`
pub async fn poscar(State(dashboard): State<Dashboard>, Path(id): Path<String>) -> ApiResult {
    let StructureRecord { id, structure, .. } = find(&dashboard.store, &id).await?;
    let mut bytes = Vec::new();
    write_poscar(&mut bytes, &structure, &id).map_err(unwritable)?;
    Ok(attachment(&format!("{id}.poscar"), bytes))
}

/// A structure as [`extxyz`] writes it.
pub async fn frame_of(store: &Store, id: &str) -> Result<Frame, ApiError> {
    let found = find(store, id).await?;
    Ok(frame(store, found).await?)
}

async fn find(store: &Store, id: &str) -> Result<StructureRecord, ApiError> {
    if let Some(number) = id.strip_prefix(candidate_details::IMPORT_PREFIX) {
        let found = match number.parse() {
            Ok(number) => store.imported_structure(number).await?,
            Err(_) => None,
        };
        let imported = store.imported_structures().await?;
        let found = found.ok_or(StoreError::UnknownImport { id: id.to_owned(), imported })?;
        let (structure, content) = (found.structure, found.content);
        return Ok(StructureRecord { id: id.to_owned(), structure, content, candidate: None });
    }
    let named = store.find_candidate(id).await?;
    let missing = || ApiError::new(StatusCode::NOT_FOUND, format!("{} is missing", named.candidate));
    let candidate = store.candidate(&named.candidate).await?.ok_or_else(missing)?;
    let view = candidate.block.view();
    let (structure, content) = (view.structure(), view.id().content);
    Ok(StructureRecord { id: named.candidate, structure, content, candidate: Some(candidate) })
}

async fn frame(store: &Store, found: StructureRecord) -> Result<Frame, StoreError> {
    let mut frame = Frame::from(found.structure);
    let labels = store.labels_of(found.content).await?;
    if let Some(labelled) = labels.into_iter().find(|label| label.record.status == LabelStatus::Label) {
        let label = labelled.record.label;
        let labels =
            FrameLabels { energy: Some(label.energy), forces: Some(label.forces), stress: label.stress };
        frame.set_labels(&labels, LabelKeys::Ase);
        frame.info.insert("protocol".to_owned(), labelled.protocol.name.into());
    }
    frame.info.insert("campaign".to_owned(), store.campaign().await?.id.to_string().into());
    let Some(candidate) = found.candidate else { return Ok(frame) };
    let view = candidate.block.view();
    frame.info.insert("candidate_id".to_owned(), found.id.into());
    frame.info.insert("origin".to_owned(), view.origin().name().into());
    frame.info.insert("relative_volume".to_owned(), view.relative_volume().into());
    let grades = [("gamma", candidate.original.gamma), ("gamma_nbr", candidate.original.gamma_nbr)];
    for (name, values) in grades.into_iter().filter(|(_, values)| values.len() == frame.structure.len()) {
        frame.arrays.insert(name.to_owned(), Column { width: 1, entries: ColumnData::Real(values) });
    }
    Ok(frame)
}

/// A file to download. Names of candidates have no quotes or line breaks.
fn attachment(name: &str, bytes: Vec<u8>) -> axum::response::Response {
    let disposition = format!("attachment; filename=\"{name}\"");
    let kind = "text/plain; charset=utf-8".to_owned();
    ([(header::CONTENT_TYPE, kind), (header::CONTENT_DISPOSITION, disposition)], bytes).into_response()
}

fn unwritable(error: impl ToString) -> ApiError {
    ApiError::new(StatusCode::UNPROCESSABLE_ENTITY, error)
}
