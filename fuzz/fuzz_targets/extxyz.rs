//! Any text parses as frames or gives an error with its line, and parsed frames can be used.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for frame in atoms::extxyz::ExtxyzReader::new(bytes).take(100) {
        let Ok(frame) = frame else { break };
        let _ = frame.structure.validate();
        let mut written = Vec::new();
        let _ = atoms::extxyz::write_frame(&mut written, &frame);
    }
});
