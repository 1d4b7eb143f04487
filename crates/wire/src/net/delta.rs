//! The difference between two versions of the mixture, as components in the order of elements and keys.

use std::sync::Arc;

use calm::{Component, ComponentBytesError, Mixture, MixtureError};
use serde::{Deserialize, Serialize};

/// Bytes of components that travel in one message, about.
const MAX_PART_BYTES: usize = 8 << 20;

/// A part of the difference from one version to another, or of a whole mixture.
#[derive(Serialize, Deserialize)]
pub(super) struct MixtureDelta<'a> {
    /// What it leads to.
    pub version: u64,
    /// What it starts from; a whole mixture otherwise.
    pub from: Option<u64>,
    /// Number of components of each element.
    pub shape: Vec<u32>,
    /// Components in which they differ, in all.
    pub total: u32,
    /// Those before this one are in other parts.
    pub skip: u32,
    /// Element and place of those in this part.
    pub keys: Vec<(u32, u32)>,
    /// Those components one after the other, all of the same length, without their statistics.
    #[serde(serialize_with = "crate::bytes::serialize")]
    pub bytes: &'a [u8],
}

/// Why what was sent is no mixture.
#[derive(Debug, thiserror::Error)]
pub enum DeltaError {
    /// Not a component.
    #[error(transparent)]
    Component(#[from] ComponentBytesError),
    /// Components that do not fit together.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
    /// Parts that do not fit together.
    #[error("a difference to version {version} of the mixture that does not fit: {what}")]
    Parts {
        /// Where it should lead to.
        version: u64,
        /// What is wrong.
        what: String,
    },
}

/// Component and place.
type IndexedComponent<'a> = ((u32, u32), &'a Arc<Component>);

/// Components of `to` that are not those of `from`.
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

/// The keys and bytes of the part of the difference that begins after `skip` components, and how many there are in all.
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

/// A mixture on its way, part by part.
pub(super) struct DeltaReceiver {
    version: u64,
    from: Option<u64>,
    elements: Vec<Vec<Option<Arc<Component>>>>,
    received: u32,
    total: u32,
}

impl DeltaReceiver {
    /// Begins with the first part. `base` is the version that it starts from, if it starts from one.
    pub(super) fn new(first: &MixtureDelta<'_>, base: Option<&Mixture>) -> Result<Self, DeltaError> {
        let wrong = |what: &str| DeltaError::Parts { version: first.version, what: what.to_owned() };
        if first.from != base.map(Mixture::version) {
            return Err(wrong("it starts from another version"));
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

    /// Whether this is the part that comes next.
    pub(super) fn is_next(&self, part: &MixtureDelta<'_>) -> bool {
        (part.version, part.from, part.total, part.skip)
            == (self.version, self.from, self.total, self.received)
    }

    /// Components received so far.
    pub(super) fn received(&self) -> u32 {
        self.received
    }

    /// Takes a part in; whether all are there.
    pub(super) fn add_part(&mut self, part: &MixtureDelta<'_>) -> Result<bool, DeltaError> {
        let wrong = |what: String| DeltaError::Parts { version: self.version, what };
        let length = part.bytes.len().checked_div(part.keys.len()).unwrap_or(0);
        if length * part.keys.len() != part.bytes.len() || (length == 0 && self.received < self.total) {
            let (bytes, keys) = (part.bytes.len(), part.keys.len());
            return Err(wrong(format!("{bytes} bytes of {keys} components")));
        }
        for (&(element, slot), bytes) in part.keys.iter().zip(part.bytes.chunks_exact(length.max(1))) {
            let component = Component::from_bytes(bytes)?;
            let place = self.elements.get_mut(element as usize).and_then(|of| of.get_mut(slot as usize));
            let place = place.ok_or_else(|| wrong(format!("no place {slot} of element {element}")))?;
            *place = Some(Arc::new(component));
        }
        self.received += part.keys.len() as u32;
        Ok(self.received >= self.total)
    }

    /// The mixture, once all parts are there.
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
