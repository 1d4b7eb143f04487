//! A message as it is sent: the control message, followed by the candidate.
//!
//! | bytes | content |
//! | --- | --- |
//! | 8 | length of the control message, little-endian |
//! | that length, padded with zeros to a multiple of 8 | the control message |
//! | rest | the candidate block, or nothing |
//!
//! The block is therefore aligned to 8 and can be read in place. Answers have no block.

use zerocopy::IntoBytes;

use crate::block::Candidate;

const PREFIX: usize = 8;

/// Why bytes are not a valid request.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Shorter than the length field.
    #[error("request too short: {0} bytes, the length field alone has {PREFIX}")]
    Short(usize),
    /// The control message is longer than the request.
    #[error("request of {found} bytes, but its control message should have {control}")]
    Length {
        /// Actual length, bytes.
        found: usize,
        /// Length of the control message, bytes.
        control: u64,
    },
}

/// Length of a message in bytes, a multiple of 8.
pub(crate) fn length(control: usize, candidate: Option<&Candidate>) -> usize {
    PREFIX + control.next_multiple_of(8) + candidate.map_or(0, Candidate::encoded_len)
}

/// Writes a message to `out`, which is aligned to 8 and has [`length`] bytes.
pub(crate) fn write(out: &mut [u8], control: &[u8], candidate: Option<&Candidate>) {
    let (prefix, rest) = out.split_at_mut(PREFIX);
    prefix.copy_from_slice(&(control.len() as u64).to_le_bytes());
    let (padded, block) = rest.split_at_mut(control.len().next_multiple_of(8));
    let (message, padding) = padded.split_at_mut(control.len());
    message.copy_from_slice(control);
    padding.fill(0);
    if let Some(candidate) = candidate {
        candidate.encode_into(block);
    }
}

/// A message in memory of this process.
pub(crate) fn to_words(control: &[u8], candidate: Option<&Candidate>) -> Vec<u64> {
    let mut words = vec![0; length(control.len(), candidate) / 8];
    write(words.as_mut_bytes(), control, candidate);
    words
}

/// A message with a candidate that is already encoded.
pub(crate) fn with_block(control: &[u8], block: Option<&[u8]>) -> Vec<u8> {
    let mut bytes = to_words(control, None).as_bytes().to_vec();
    bytes.extend_from_slice(block.unwrap_or_default());
    bytes
}

/// Splits a request into control message and candidate block.
pub(crate) fn split(request: &[u8]) -> Result<(&[u8], &[u8]), FrameError> {
    let Some((prefix, rest)) = request.split_first_chunk() else {
        return Err(FrameError::Short(request.len()));
    };
    let control = u64::from_le_bytes(*prefix);
    let length = FrameError::Length { found: request.len(), control };
    let Ok(end) = usize::try_from(control) else { return Err(length) };
    match (rest.get(..end), end.checked_next_multiple_of(8).and_then(|padded| rest.get(padded..))) {
        (Some(message), Some(block)) => Ok((message, block)),
        _ => Err(length),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_messages_survive_a_round_trip_and_blocks_are_aligned() {
        for content in 0..20_u8 {
            let message: Vec<u8> = (0..content).collect();
            let mut bytes = vec![0xff; length(message.len(), None)];
            write(&mut bytes, &message, None);
            assert_eq!(split(&bytes), Ok((message.as_slice(), &[][..])));
            bytes.extend([7; 3]);
            let (_, block) = split(&bytes).unwrap();
            assert_eq!((block, (bytes.len() - block.len()) % 8), (&[7; 3][..], 0));
        }
    }

    #[test]
    fn lengths_are_not_trusted() {
        assert_eq!(split(&[0; 7]), Err(FrameError::Short(7)));
        for control in [1, 9, 1 << 40, u64::MAX - 6, u64::MAX] {
            let bytes = control.to_le_bytes();
            assert_eq!(split(&bytes), Err(FrameError::Length { found: 8, control }));
        }
        // The message would fit, its padding would not.
        let bytes = [&3_u64.to_le_bytes()[..], &[0; 3]].concat();
        assert_eq!(split(&bytes), Err(FrameError::Length { found: 11, control: 3 }));
    }
}
