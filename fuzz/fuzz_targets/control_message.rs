//! Arbitrary bytes are decoded as a message between walker and orchestrator or rejected, and decoded messages survive a
//! round trip.
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
        // Numbers may be NaN, which is not equal to itself, so the encoded bytes are compared.
        assert_eq!(reencode(&reencoded)[role].as_ref(), Some(&reencoded));
    }
}

/// The bytes with a valid header, so that the code after the checksum is reached.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let control = [b"CALM\x02".as_slice(), &crc32fast::hash(bytes).to_le_bytes(), bytes].concat();
    let mut framed = [(control.len() as u64).to_le_bytes().as_slice(), &control].concat();
    framed.resize(framed.len().next_multiple_of(8), 0);
    framed
}
