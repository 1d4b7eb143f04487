//! Any bytes are a message between walker and orchestrator or are refused, and a message comes back from its own bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wire::ipc::reencode;

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    read(&framed(bytes));
});

fn read(bytes: &[u8]) {
    for (role, echoed) in echo(bytes).into_iter().enumerate() {
        let Some(echoed) = echoed else { continue };
        // Numbers may be NaN, which is not equal to itself: compare what is sent.
        assert_eq!(echo(&echoed)[role].as_ref(), Some(&echoed));
    }
}

/// The bytes behind a beginning that fits them, so that what lies behind the checksum is reached.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let control = [b"CALM\x02".as_slice(), &crc32fast::hash(bytes).to_le_bytes(), bytes].concat();
    let mut framed = [(control.len() as u64).to_le_bytes().as_slice(), &control].concat();
    framed.resize(framed.len().next_multiple_of(8), 0);
    framed
}
