-- Versions of the potential, and attempts at one that were refused, numbered from 1 without gaps. `parent` is the version from which it
-- was trained: a registered one, or 0, that of the configuration. `reason` is empty unless it was refused, and both hashes (BLAKE3,
-- hexadecimal) are empty if it was. `figures` is JSON. `time` is in ms since 1970. Rows never change.
CREATE TABLE version (
    number INTEGER PRIMARY KEY,
    parent INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('registered', 'refused')),
    reason TEXT NOT NULL,
    method TEXT NOT NULL,
    structures INTEGER NOT NULL,
    last_decision INTEGER NOT NULL,
    labels INTEGER NOT NULL,
    model_hash TEXT NOT NULL,
    mixture_hash TEXT NOT NULL,
    figures TEXT NOT NULL,
    seconds REAL NOT NULL,
    core_hours REAL NOT NULL,
    time INTEGER NOT NULL,
    checksum INTEGER NOT NULL
) STRICT;

-- The two files of each registered version, tens of MB each. The hashes in `version` cover them.
CREATE TABLE version_file (
    version INTEGER NOT NULL REFERENCES version,
    name TEXT NOT NULL CHECK (name IN ('model', 'mixture')),
    data BLOB NOT NULL,
    PRIMARY KEY (version, name)
) STRICT;

PRAGMA user_version = 17;
