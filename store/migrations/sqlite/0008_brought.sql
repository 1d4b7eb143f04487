-- What those attempts took that brought labels, of `core_milliseconds`: what attempts in vain add to the price of a label is known without
-- a look at all of them.
INSERT INTO campaign SELECT 'label_core_milliseconds', CAST(coalesce(sum(coalesce(CAST(round(1000 * core_seconds) AS INTEGER),
    CASE WHEN ended > started THEN (ended - started) * coalesce(cores, 1) ELSE 0 END)), 0) AS TEXT)
    FROM attempt WHERE outcome IN ('labelled', 'check');

CREATE TRIGGER brought AFTER UPDATE OF ended, outcome, cores, core_seconds ON attempt WHEN NEW.outcome IS NOT NULL
BEGIN
    UPDATE campaign SET value = CAST(CAST(value AS INTEGER)
        + CASE WHEN NEW.outcome IN ('labelled', 'check') THEN coalesce(CAST(round(1000 * NEW.core_seconds) AS INTEGER),
            CASE WHEN NEW.ended > NEW.started THEN (NEW.ended - NEW.started) * coalesce(NEW.cores, 1) ELSE 0 END) ELSE 0 END
        - CASE WHEN OLD.outcome IN ('labelled', 'check') THEN coalesce(CAST(round(1000 * OLD.core_seconds) AS INTEGER),
            CASE WHEN OLD.ended > OLD.started THEN (OLD.ended - OLD.started) * coalesce(OLD.cores, 1) ELSE 0 END) ELSE 0 END
        AS TEXT)
    WHERE key = 'label_core_milliseconds';
END;

PRAGMA user_version = 8;
