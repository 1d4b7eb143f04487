-- The conditions of each walk, as JSON: group, temperature (K), τ, volume ramp, repetition. They never change. Campaigns of earlier
-- versions have none: all their walks have those of the configuration.
CREATE TABLE walk_conditions (
    walk INTEGER PRIMARY KEY,
    conditions TEXT NOT NULL,
    checksum INTEGER
) STRICT;

PRAGMA user_version = 11;
