-- What migrations/sqlite/0008_brought.sql adds. No attempt ends while they are summed.
LOCK TABLE attempt IN SHARE ROW EXCLUSIVE MODE;
INSERT INTO campaign SELECT 'label_core_milliseconds', CAST(coalesce(sum(core_milliseconds(made)), 0) AS TEXT)
    FROM attempt AS made WHERE outcome IN ('labelled', 'check');

CREATE OR REPLACE FUNCTION write_down_what_was_spent() RETURNS TRIGGER LANGUAGE plpgsql AS $$
DECLARE
    brings CONSTANT INTEGER := CASE WHEN NEW.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END;
    brought CONSTANT INTEGER := CASE WHEN OLD.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END;
BEGIN
    PERFORM lock_counts();
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT) + brings - brought AS TEXT) WHERE key = 'labels_made';
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT) + core_milliseconds(NEW) - core_milliseconds(OLD) AS TEXT)
    WHERE key = 'core_milliseconds';
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT)
        + brings * core_milliseconds(NEW) - brought * core_milliseconds(OLD) AS TEXT)
    WHERE key = 'label_core_milliseconds';
    RETURN NULL;
END $$;
