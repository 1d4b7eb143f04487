-- Labels that somebody has taken out of the data set: when (ms since 1970), and why. They keep both when another label supersedes
-- them, and lose both when they are taken in again; the log of operations has all of it.
ALTER TABLE label ADD COLUMN excluded INTEGER;
ALTER TABLE label ADD COLUMN exclusion TEXT;

-- A further standing of labels. As in 0006, only a CHECK changes.
PRAGMA writable_schema = ON;
UPDATE sqlite_schema SET sql = replace(sql, '''check'', ''superseded'')', '''check'', ''superseded'', ''excluded'')')
    WHERE type = 'table' AND name = 'label';
PRAGMA writable_schema = RESET;

CREATE INDEX label_excluded ON label (structure, protocol) WHERE standing = 'excluded';

PRAGMA user_version = 10;
