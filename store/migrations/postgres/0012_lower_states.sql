-- What migrations/sqlite/0012_lower_states.sql adds.
CREATE INDEX label_other ON label (structure, protocol, energy) WHERE standing IN ('check', 'superseded') AND excluded IS NULL;
