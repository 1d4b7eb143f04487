-- Labels that are made anew. `relabel` is why another label was asked for although there is one, until it has come; attempts up to
-- number `relabel_after` were begun before that and do not count for it.
ALTER TABLE job ADD COLUMN relabel TEXT;
ALTER TABLE job ADD COLUMN relabel_after INTEGER;

-- When and why another label came in the place of this one.
ALTER TABLE label ADD COLUMN superseded INTEGER;
ALTER TABLE label ADD COLUMN reason TEXT;

-- A further state of jobs: one by another protocol is in its place. Only a CHECK changes, and nothing that is stored, which SQLite's
-- manual allows to do in this way (lang_altertable.html): another would copy every label.
PRAGMA writable_schema = ON;
UPDATE sqlite_schema SET sql = replace(sql, '''failed'', ''dropped'')', '''failed'', ''dropped'', ''superseded'')')
    WHERE type = 'table' AND name = 'job';
PRAGMA writable_schema = RESET;

CREATE INDEX job_relabel ON job (state) WHERE relabel IS NOT NULL;

PRAGMA user_version = 6;
