-- Imported structures may wait for a label too. The `decision` of their jobs is 2^40 + import.number, since no decision was made: they
-- come after candidates of the same priority, in the order of the import. As in 0006, only a constraint changes.
PRAGMA writable_schema = ON;
UPDATE sqlite_schema SET sql = replace(sql, 'decision INTEGER NOT NULL REFERENCES candidate', 'decision INTEGER NOT NULL')
    WHERE type = 'table' AND name = 'job';
PRAGMA writable_schema = RESET;

-- Jobs of imported structures are counted under the seed structure 4294967295, which does not exist.
DROP TRIGGER job_came;
DROP TRIGGER job_moved;
CREATE TRIGGER job_came AFTER INSERT ON job
BEGIN
    INSERT INTO job_count SELECT NEW.protocol, NEW.state,
            coalesce((SELECT seed_structure FROM candidate WHERE decision = NEW.decision), 4294967295), formula, atoms, 1
        FROM structure WHERE structure.number = NEW.structure ON CONFLICT DO UPDATE SET number = number + 1;
END;
CREATE TRIGGER job_moved AFTER UPDATE OF state ON job WHEN NEW.state <> OLD.state
BEGIN
    INSERT INTO job_count SELECT OLD.protocol, OLD.state,
            coalesce((SELECT seed_structure FROM candidate WHERE decision = OLD.decision), 4294967295), formula, atoms, -1
        FROM structure WHERE structure.number = OLD.structure ON CONFLICT DO UPDATE SET number = number - 1;
    INSERT INTO job_count SELECT NEW.protocol, NEW.state,
            coalesce((SELECT seed_structure FROM candidate WHERE decision = NEW.decision), 4294967295), formula, atoms, 1
        FROM structure WHERE structure.number = NEW.structure ON CONFLICT DO UPDATE SET number = number + 1;
END;

PRAGMA user_version = 13;
