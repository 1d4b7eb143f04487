-- "CALM", and the version of the schema: what Store::open looks at first.
PRAGMA application_id = 1128352845;
PRAGMA user_version = 1;

-- What the campaign is: its id, the program that began it, its configuration.
CREATE TABLE campaign (
    key TEXT PRIMARY KEY,
    value TEXT NOT NULL
) STRICT, WITHOUT ROWID;

-- Small named values of the selector.
CREATE TABLE value (
    name TEXT PRIMARY KEY,
    value TEXT NOT NULL
) STRICT, WITHOUT ROWID;

-- Structures that have, or may get, a label; and those where walks start.
CREATE TABLE structure (
    number INTEGER PRIMARY KEY,
    hash BLOB NOT NULL UNIQUE,
    atoms INTEGER NOT NULL,
    formula TEXT NOT NULL,
    data BLOB NOT NULL
) STRICT;

CREATE TABLE seed_structure (
    seed INTEGER PRIMARY KEY,
    name TEXT NOT NULL,
    source TEXT NOT NULL,
    structure INTEGER NOT NULL REFERENCES structure
) STRICT;

CREATE TABLE protocol (
    number INTEGER PRIMARY KEY,
    hash BLOB NOT NULL UNIQUE,
    name TEXT NOT NULL UNIQUE,
    settings TEXT NOT NULL
) STRICT;

-- The decision log: one total order without gaps, and nothing that differs between two runs.
CREATE TABLE decision (
    sequence INTEGER PRIMARY KEY,
    round INTEGER NOT NULL,
    kind TEXT NOT NULL,
    walk INTEGER,
    candidate TEXT,
    mixture_version INTEGER NOT NULL,
    detail TEXT NOT NULL
) STRICT;

-- A candidate is numbered by the decision about it. Grades are largest γ, largest γ_nbr and the number
-- of atoms with γ > 1; NULL where there is no finite number.
CREATE TABLE candidate (
    decision INTEGER PRIMARY KEY REFERENCES decision,
    id TEXT NOT NULL UNIQUE,
    content BLOB NOT NULL,
    structure INTEGER REFERENCES structure,
    walk INTEGER NOT NULL,
    segment INTEGER NOT NULL,
    step INTEGER NOT NULL,
    seed_structure INTEGER NOT NULL,
    origin TEXT NOT NULL CHECK (origin IN ('biased', 'control')),
    fate TEXT NOT NULL CHECK (fate IN ('accepted', 'declined')),
    reason TEXT,
    mixture_version INTEGER NOT NULL,
    atoms INTEGER NOT NULL,
    formula TEXT NOT NULL,
    temperature REAL,
    relative_volume REAL,
    energy REAL,
    walker_gamma REAL,
    walker_gamma_nbr REAL,
    walker_above INTEGER,
    selector_gamma REAL,
    selector_gamma_nbr REAL,
    selector_above INTEGER,
    original_gamma REAL,
    original_gamma_nbr REAL,
    original_above INTEGER,
    CHECK ((fate = 'accepted') = (structure IS NOT NULL)),
    CHECK ((fate = 'declined') = (reason IS NOT NULL))
) STRICT;
CREATE INDEX candidate_fate ON candidate (origin, fate, reason);
CREATE INDEX candidate_structure ON candidate (structure) WHERE structure IS NOT NULL;

-- The long rows of candidates, apart from what summaries read.
CREATE TABLE candidate_data (
    decision INTEGER PRIMARY KEY REFERENCES candidate,
    block BLOB NOT NULL,
    features BLOB,
    selector_grades BLOB,
    original_grades BLOB
) STRICT;

CREATE TABLE component (
    element INTEGER NOT NULL,
    slot INTEGER NOT NULL,
    bytes BLOB NOT NULL,
    PRIMARY KEY (element, slot)
) STRICT;

CREATE TABLE walk (
    walk INTEGER PRIMARY KEY,
    origin TEXT NOT NULL CHECK (origin IN ('biased', 'control')),
    partner INTEGER,
    seed_structure INTEGER NOT NULL,
    state TEXT NOT NULL,
    reason TEXT NOT NULL,
    turn INTEGER NOT NULL,
    accepted INTEGER NOT NULL,
    step INTEGER NOT NULL,
    segment INTEGER NOT NULL,
    tau REAL,
    temperature REAL,
    relative_volume REAL,
    gamma_max REAL,
    refused INTEGER NOT NULL,
    returns INTEGER NOT NULL,
    selector_state TEXT NOT NULL,
    checkpoint BLOB
) STRICT;

-- The label queue. `failures` counts the attempts that failed or ran out of time since the job was last queued
-- by hand; `attempts` counts all of them.
CREATE TABLE job (
    number INTEGER PRIMARY KEY,
    structure INTEGER NOT NULL REFERENCES structure,
    protocol INTEGER NOT NULL REFERENCES protocol,
    decision INTEGER NOT NULL REFERENCES candidate,
    state TEXT NOT NULL CHECK (state IN ('queued', 'leased', 'labelled', 'failed', 'dropped')),
    priority INTEGER NOT NULL,
    holder TEXT,
    expires INTEGER,
    attempts INTEGER NOT NULL DEFAULT 0,
    failures INTEGER NOT NULL DEFAULT 0,
    UNIQUE (structure, protocol),
    CHECK ((state = 'leased') = (holder IS NOT NULL)),
    CHECK ((state = 'leased') = (expires IS NOT NULL))
) STRICT;
CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);

-- `calculation` is what finds the calculation again: a process group, a batch system's number.
CREATE TABLE attempt (
    job INTEGER NOT NULL REFERENCES job,
    attempt INTEGER NOT NULL,
    holder TEXT NOT NULL,
    calculation TEXT,
    started INTEGER NOT NULL,
    ended INTEGER,
    outcome TEXT,
    class TEXT,
    log TEXT,
    PRIMARY KEY (job, attempt),
    CHECK ((ended IS NULL) = (outcome IS NULL))
) STRICT;

-- Labels are added, never changed; only their standing moves from 'label' to 'superseded'.
CREATE TABLE label (
    number INTEGER PRIMARY KEY,
    structure INTEGER NOT NULL REFERENCES structure,
    protocol INTEGER NOT NULL REFERENCES protocol,
    standing TEXT NOT NULL CHECK (standing IN ('label', 'check', 'superseded')),
    energy REAL NOT NULL,
    forces BLOB NOT NULL,
    stress BLOB,
    job INTEGER REFERENCES job,
    attempt INTEGER,
    file TEXT,
    frame INTEGER,
    correction TEXT,
    received INTEGER NOT NULL
) STRICT;
CREATE UNIQUE INDEX label_of ON label (structure, protocol) WHERE standing = 'label';
CREATE INDEX label_history ON label (structure, protocol, number);

-- Structures that came with their labels, in the order in which they came.
CREATE TABLE import (
    number INTEGER PRIMARY KEY,
    structure INTEGER NOT NULL UNIQUE REFERENCES structure,
    file TEXT NOT NULL,
    frame INTEGER NOT NULL
) STRICT;

-- The operations log: what merely happened.
CREATE TABLE operation (
    number INTEGER PRIMARY KEY,
    time INTEGER NOT NULL,
    kind TEXT NOT NULL,
    detail TEXT NOT NULL
) STRICT;

CREATE TABLE process (
    id TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    pid INTEGER NOT NULL,
    host TEXT NOT NULL,
    started INTEGER NOT NULL,
    last_seen INTEGER NOT NULL,
    state TEXT NOT NULL
) STRICT;
