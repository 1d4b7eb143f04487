-- CRC-32 of what stands in a row (`src/checksum.rs`). The program computes those of rows that are there already, in the
-- transaction in which it makes these columns. The checksums of the long columns of `candidate_data` stand with the candidates.
ALTER TABLE campaign ADD COLUMN checksum INTEGER;
ALTER TABLE value ADD COLUMN checksum INTEGER;
ALTER TABLE structure ADD COLUMN checksum INTEGER;
ALTER TABLE seed_structure ADD COLUMN checksum INTEGER;
ALTER TABLE protocol ADD COLUMN checksum INTEGER;
ALTER TABLE decision ADD COLUMN checksum INTEGER;
ALTER TABLE candidate ADD COLUMN checksum INTEGER;
ALTER TABLE candidate ADD COLUMN features_checksum INTEGER;
ALTER TABLE candidate ADD COLUMN selector_checksum INTEGER;
ALTER TABLE candidate ADD COLUMN original_checksum INTEGER;
ALTER TABLE component ADD COLUMN checksum INTEGER;
ALTER TABLE walk ADD COLUMN checksum INTEGER;
ALTER TABLE walk ADD COLUMN checkpoint_checksum INTEGER;
ALTER TABLE label ADD COLUMN checksum INTEGER;
ALTER TABLE import ADD COLUMN checksum INTEGER;
ALTER TABLE archive ADD COLUMN checksum INTEGER;

-- A labeller of an earlier version may still be at work.
CREATE TRIGGER label_has_checksum BEFORE INSERT ON label WHEN NEW.checksum IS NULL
BEGIN
    SELECT RAISE(ABORT, 'a newer version of calmwalk has brought this campaign up to date: start this labeller anew with it');
END;

PRAGMA user_version = 9;
