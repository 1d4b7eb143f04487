//! Damages files in ways determined by a number.

/// Number of mutations of each file: `small`, or `CALMWALK_MUTATIONS`.
pub fn mutations(small: u64) -> u64 {
    std::env::var("CALMWALK_MUTATIONS").ok().and_then(|text| text.parse().ok()).unwrap_or(small)
}

/// Insertions for text files: extreme numbers and delimiters.
const WORDS: [&str; 28] = [
    "0",
    "-1",
    "1e999",
    "-0",
    "nan",
    "inf",
    "1e-320",
    "99999999999999999999",
    "-9223372036854775808",
    "\n",
    "\r\n",
    "\0",
    "\t",
    " ",
    "\"",
    "'",
    "\\",
    "=",
    "[",
    "]",
    "[[",
    "{",
    "}",
    "#",
    ",",
    ":",
    "é",
    "\u{feff}",
];

/// Applies one to four mutations: flips a bit, sets a byte, truncates, removes, duplicates or moves a part, or
/// inserts a word.
pub fn mutated(bytes: &[u8], number: u64) -> Vec<u8> {
    let mut source = number.wrapping_mul(0x2545_f491_4f6c_dd1d);
    let mut below = |bound: usize| {
        source = source.wrapping_add(1);
        (random(source) % bound.max(1) as u64) as usize
    };
    let mut bytes = bytes.to_vec();
    for _ in 0..=below(4) {
        let length = bytes.len();
        let at = below(length);
        let part = at..(at + 1 + below(64)).min(length);
        match below(8) {
            0 if length > 0 => bytes[at] ^= 1 << below(8),
            1 if length > 0 => bytes[at] = below(256) as u8,
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(part)),
            4 => {
                let doubled = bytes[part].to_vec();
                bytes.splice(at..at, doubled);
            }
            5 => {
                let moved: Vec<u8> = bytes.drain(part).collect();
                let to = below(bytes.len() + 1);
                bytes.splice(to..to, moved);
            }
            6 => {
                let word = WORDS[below(WORDS.len())];
                bytes.splice(at..at, word.bytes());
            }
            _ => {
                // Replaces a number by another.
                let is_of_number =
                    |byte: &u8| byte.is_ascii_digit() || matches!(byte, b'.' | b'-' | b'+' | b'e');
                let begin = (at..length).find(|place| is_of_number(&bytes[*place])).unwrap_or(at);
                let end = (begin..length).find(|place| !is_of_number(&bytes[*place])).unwrap_or(length);
                bytes.splice(begin..end, WORDS[below(9)].bytes());
            }
        }
    }
    bytes
}

/// A copy of the function in `common`, since this file is also compiled without it.
fn random(seed: u64) -> u64 {
    let mut z = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
