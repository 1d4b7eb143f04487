//! Arbitrary bytes parse as a message between walker and orchestrator or are rejected, and a message re-encodes to
//! the same bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wire::ipc::reencode;

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    read(&framed(bytes));
});

fn read(bytes: &[u8]) {
    for (role, reencoded) in reencode(bytes).into_iter().enumerate() {
        let Some(reencoded) = reencoded else { continue };
        // NaN is not equal to itself, so compare the encoded messages.
        assert_eq!(reencode(&reencoded)[role].as_ref(), Some(&reencoded));
    }
}

/// Prepends a valid header, so that the fuzzer reaches the code after the checksum.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let control = [b"CALM\x06".as_slice(), &crc32fast::hash(bytes).to_le_bytes(), bytes].concat();
    let mut framed = [(control.len() as u64).to_le_bytes().as_slice(), &control].concat();
    framed.resize(framed.len().next_multiple_of(8), 0);
    framed
}
