-- Results beside the label, by which a lower state of the same structure is found.
CREATE INDEX label_other ON label (structure, protocol, energy) WHERE standing IN ('check', 'superseded') AND excluded IS NULL;

PRAGMA user_version = 12;
