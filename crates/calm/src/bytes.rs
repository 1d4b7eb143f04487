//! The serialized form of a component, for the store, the wire and shared memory.
//!
//! Little-endian: magic `CALMCOMP`, format version (u32), D (u32), flags (u64, bit 0: statistics present), θ,
//! then **μ** `[D]`, the lower triangle of S by rows `[D(D+1)/2]`, and with statistics count, effective count
//! and the lower triangle of the scatter. Everything after the flags is `f64`. S and scatter are exactly
//! symmetric, so the triangles are complete and a round trip preserves every bit.

use crate::component::{Component, ComponentError, Statistics};

const MAGIC: [u8; 8] = *b"CALMCOMP";
const FORMAT: u32 = 1;
const HEADER: usize = 24;
const WITH_STATISTICS: u64 = 1;

/// Bytes that are not a component.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ComponentBytesError {
    /// Fewer bytes than a header.
    #[error("{found} bytes are too few for a mixture component, whose header alone has {HEADER}")]
    Truncated {
        /// Bytes found.
        found: usize,
    },
    /// Not a component.
    #[error("these bytes are not a mixture component: they start with {found:02x?}, expected {MAGIC:02x?}")]
    Magic {
        /// The first eight bytes.
        found: [u8; 8],
    },
    /// The format of another program version.
    #[error("component format {found}, this program reads {FORMAT}")]
    Format {
        /// Format version found.
        found: u32,
    },
    /// Unknown flags.
    #[error("component flags {found:#x}, this program knows {WITH_STATISTICS:#x}")]
    Flags {
        /// Flags found.
        found: u64,
    },
    /// A length that contradicts the header.
    #[error("a component of {dimension} features {} statistics does not have {found} bytes",
        if *.statistics { "with" } else { "without" })]
    Length {
        /// Feature dimension in the header.
        dimension: u32,
        /// Whether the header announces statistics.
        statistics: bool,
        /// Bytes found.
        found: usize,
    },
    /// Numbers that are not a valid component.
    #[error("the bytes are not a valid component: {0}")]
    Component(#[from] ComponentError),
}

impl Component {
    /// The component as bytes; [`Component::from_bytes`] gives back the same bits.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.bytes_with(self.statistics())
    }

    /// The component without its statistics: enough for grading, and half as long.
    pub fn to_bytes_without_statistics(&self) -> Vec<u8> {
        self.bytes_with(None)
    }

    fn bytes_with(&self, statistics: Option<&Statistics>) -> Vec<u8> {
        let dimension = self.dimension();
        let flags = if statistics.is_some() { WITH_STATISTICS } else { 0 };
        let mut out = Vec::with_capacity(HEADER + 8 * (2 + dimension * (dimension + 2)));
        out.extend(MAGIC);
        out.extend(FORMAT.to_le_bytes());
        out.extend((dimension as u32).to_le_bytes());
        out.extend(flags.to_le_bytes());
        let mut put = |number: f64| out.extend(number.to_le_bytes());
        put(self.threshold());
        self.centroid().iter().copied().for_each(&mut put);
        lower_triangle(self.inverse(), dimension).for_each(&mut put);
        if let Some(Statistics { scatter, count, effective_count }) = statistics {
            put(*count);
            put(*effective_count);
            lower_triangle(scatter, dimension).for_each(&mut put);
        }
        out
    }

    /// Reads the output of [`Component::to_bytes`].
    ///
    /// # Errors
    /// Other data, another format, a length that contradicts the header, numbers that are not a valid
    /// component.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ComponentBytesError> {
        let (dimension, statistics) = header(bytes)?;
        if Some(bytes.len()) != expected_length(dimension, statistics) {
            return Err(ComponentBytesError::Length { dimension, statistics, found: bytes.len() });
        }
        let size = dimension as usize;
        let packed = size * (size + 1) / 2;
        let mut numbers = Numbers(bytes.get(HEADER..).unwrap_or_default());
        let threshold = numbers.next();
        let centroid = numbers.take(size);
        let inverse = unpacked(&numbers.take(packed), size);
        let statistics = statistics.then(|| {
            let (count, effective_count) = (numbers.next(), numbers.next());
            Statistics { scatter: unpacked(&numbers.take(packed), size), count, effective_count }
        });
        Ok(Component::new(centroid, inverse, threshold, statistics)?)
    }
}

/// Reads little-endian numbers from the front of a slice; `None` at its end.
struct Numbers<'a>(&'a [u8]);

impl Numbers<'_> {
    fn next(&mut self) -> f64 {
        let Some((word, rest)) = self.0.split_first_chunk() else { return f64::NAN };
        self.0 = rest;
        f64::from_le_bytes(*word)
    }

    fn take(&mut self, count: usize) -> Vec<f64> {
        (0..count).map(|_| self.next()).collect()
    }
}

/// Feature dimension and whether statistics follow.
fn header(bytes: &[u8]) -> Result<(u32, bool), ComponentBytesError> {
    let truncated = ComponentBytesError::Truncated { found: bytes.len() };
    let Some((magic, rest)) = bytes.split_first_chunk::<8>() else { return Err(truncated) };
    let Some((format, rest)) = rest.split_first_chunk::<4>() else { return Err(truncated) };
    let Some((dimension, rest)) = rest.split_first_chunk::<4>() else { return Err(truncated) };
    let Some((flags, _)) = rest.split_first_chunk::<8>() else { return Err(truncated) };
    if *magic != MAGIC {
        return Err(ComponentBytesError::Magic { found: *magic });
    }
    let (format, flags) = (u32::from_le_bytes(*format), u64::from_le_bytes(*flags));
    if format != FORMAT {
        return Err(ComponentBytesError::Format { found: format });
    }
    if flags & !WITH_STATISTICS != 0 {
        return Err(ComponentBytesError::Flags { found: flags });
    }
    Ok((u32::from_le_bytes(*dimension), flags == WITH_STATISTICS))
}

fn expected_length(dimension: u32, statistics: bool) -> Option<usize> {
    let size = usize::try_from(dimension).ok()?;
    let packed = size.checked_mul(size.checked_add(1)?)? / 2;
    let base = packed.checked_add(size)?.checked_add(1)?;
    let numbers = if statistics { base.checked_add(packed)?.checked_add(2)? } else { base };
    numbers.checked_mul(8)?.checked_add(HEADER)
}

fn lower_triangle(matrix: &[f64], dimension: usize) -> impl Iterator<Item = f64> {
    matrix.chunks_exact(dimension).enumerate().flat_map(|(row, values)| values.iter().take(row + 1).copied())
}

fn unpacked(packed: &[f64], dimension: usize) -> Vec<f64> {
    let mut out = vec![0.0; dimension * dimension];
    let mut values = packed.iter();
    for row in 0..dimension {
        for (column, &value) in (0..=row).zip(values.by_ref()) {
            out[row * dimension + column] = value;
            out[column * dimension + row] = value;
        }
    }
    out
}
