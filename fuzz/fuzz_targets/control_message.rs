//! Any bytes are a control message or an error, and a message comes back from its own bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wire::control::{Message, decode, encode};

fuzz_target!(|bytes: &[u8]| {
    let _ = decode(bytes, None);
    let sealed = [b"CALM\x01".as_slice(), &crc32fast::hash(bytes).to_le_bytes(), bytes].concat();
    if let Ok(message) = decode(&sealed, None) {
        if let Message::Assignment(assignment) = &message {
            assert_eq!(assignment.seed_structure.validate(), Ok(()));
        }
        // Numbers may be NaN, which is not equal to itself: compare what is sent.
        let again = decode(&encode(&message), None).unwrap();
        assert_eq!(encode(&again), encode(&message));
    }
});
