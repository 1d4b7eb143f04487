//! Deltas between versions of the mixture: lists of components, ordered by element and slot.

use std::sync::Arc;

use calm::{Component, ComponentBytesError, Mixture, MixtureError};
use serde::{Deserialize, Serialize};

/// Approximate maximum size of the components in one message, bytes.
const MAX_PART_BYTES: usize = 8 << 20;

/// A part of a delta between two versions, or of a complete mixture.
#[derive(Serialize, Deserialize)]
pub(super) struct MixtureDelta<'a> {
    /// Resulting version.
    pub version: u64,
    /// Base version; `None` for a complete mixture.
    pub from: Option<u64>,
    /// Number of components of each element.
    pub shape: Vec<u32>,
    /// Total number of changed components.
    pub total: u32,
    /// Number of components in earlier parts.
    pub skip: u32,
    /// Element and slot of each component in this part.
    pub keys: Vec<(u32, u32)>,
    /// The encoded components, all of the same length, without their statistics.
    #[serde(serialize_with = "crate::bytes::serialize")]
    pub bytes: &'a [u8],
}

/// Why a received delta is invalid.
#[derive(Debug, thiserror::Error)]
pub enum DeltaError {
    /// An invalid component.
    #[error(transparent)]
    Component(#[from] ComponentBytesError),
    /// Components that do not form a mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
    /// Parts that do not match.
    #[error("invalid delta to version {version} of the mixture: {what}")]
    Parts {
        /// Resulting version.
        version: u64,
        /// What is wrong.
        what: String,
    },
}

/// Element and slot of a component, and the component.
type IndexedComponent<'a> = ((u32, u32), &'a Arc<Component>);

/// Components of `to` that differ from `from`.
fn changed_components<'a>(
    from: Option<&'a Mixture>,
    to: &'a Mixture,
) -> impl Iterator<Item = IndexedComponent<'a>> {
    to.iter().filter_map(move |(element, slot, component)| {
        let before = from.and_then(|from| from.component(element, slot));
        let same = before.is_some_and(|before| Arc::ptr_eq(before, component));
        (!same).then_some(((element as u32, slot as u32), component))
    })
}

/// The part of the delta after `skip` components: total number of components, their keys, and their bytes.
pub(super) fn part(from: Option<&Mixture>, to: &Mixture, skip: u32) -> (u32, Vec<(u32, u32)>, Vec<u8>) {
    let (mut total, mut keys, mut bytes) = (0, Vec::new(), Vec::new());
    for (key, component) in changed_components(from, to) {
        if total >= skip && bytes.len() < MAX_PART_BYTES {
            keys.push(key);
            bytes.extend(component.to_bytes_without_statistics());
        }
        total += 1;
    }
    (total, keys, bytes)
}

/// Number of components of each element.
pub(super) fn shape(mixture: &Mixture) -> Vec<u32> {
    (0..mixture.element_count()).map(|k| mixture.components(k).map_or(0, <[_]>::len) as u32).collect()
}

/// Assembles a mixture from parts.
pub(super) struct DeltaReceiver {
    version: u64,
    from: Option<u64>,
    elements: Vec<Vec<Option<Arc<Component>>>>,
    received: u32,
    total: u32,
}

impl DeltaReceiver {
    /// Starts with the first part. `base` is the base version, if there is one.
    pub(super) fn new(first: &MixtureDelta<'_>, base: Option<&Mixture>) -> Result<Self, DeltaError> {
        let wrong = |what: &str| DeltaError::Parts { version: first.version, what: what.to_owned() };
        if first.from != base.map(Mixture::version) {
            return Err(wrong("it has another base version"));
        }
        let elements = match base {
            Some(base) if shape(base) != first.shape => return Err(wrong("it has another shape")),
            Some(base) => (0..base.element_count())
                .map(|k| base.components(k).unwrap_or_default().iter().cloned().map(Some).collect())
                .collect(),
            None if first.shape.iter().map(|n| u64::from(*n)).sum::<u64>() != u64::from(first.total) => {
                return Err(wrong("components are missing"));
            }
            None => first.shape.iter().map(|n| vec![None; *n as usize]).collect(),
        };
        let (version, from, total) = (first.version, first.from, first.total);
        Ok(Self { version, from, elements, received: 0, total })
    }

    /// Whether this is the expected next part.
    pub(super) fn is_next(&self, part: &MixtureDelta<'_>) -> bool {
        (part.version, part.from, part.total, part.skip)
            == (self.version, self.from, self.total, self.received)
    }

    /// Number of components received.
    pub(super) fn received(&self) -> u32 {
        self.received
    }

    /// Adds a part. Returns whether it was the last.
    pub(super) fn add_part(&mut self, part: &MixtureDelta<'_>) -> Result<bool, DeltaError> {
        let wrong = |what: String| DeltaError::Parts { version: self.version, what };
        let length = part.bytes.len().checked_div(part.keys.len()).unwrap_or(0);
        if length * part.keys.len() != part.bytes.len() || (length == 0 && self.received < self.total) {
            let (bytes, keys) = (part.bytes.len(), part.keys.len());
            return Err(wrong(format!("{bytes} bytes of {keys} components")));
        }
        for (&(element, slot), bytes) in part.keys.iter().zip(part.bytes.chunks_exact(length.max(1))) {
            let component = Component::from_bytes(bytes)?;
            let entry = self.elements.get_mut(element as usize).and_then(|of| of.get_mut(slot as usize));
            let entry = entry.ok_or_else(|| wrong(format!("no component {slot} of element {element}")))?;
            *entry = Some(Arc::new(component));
        }
        self.received += part.keys.len() as u32;
        Ok(self.received >= self.total)
    }

    /// The mixture, after the last part.
    pub(super) fn finish(self) -> Result<Mixture, DeltaError> {
        let version = self.version;
        let elements: Option<_> = self.elements.into_iter().map(|of| of.into_iter().collect()).collect();
        let elements = elements.ok_or_else(|| {
            let what = "components are missing".to_owned();
            DeltaError::Parts { version, what }
        })?;
        Ok(Mixture::new(version, elements)?)
    }
}
