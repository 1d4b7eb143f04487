-- CRC-32 of what stands in a row (`src/checksum.rs`). The program computes those of rows that are there already, in the
-- transaction in which it makes these columns. The checksums of the long columns of `candidate_data` stand with the candidates.
ALTER TABLE campaign ADD COLUMN checksum BIGINT;
ALTER TABLE value ADD COLUMN checksum BIGINT;
ALTER TABLE structure ADD COLUMN checksum BIGINT;
ALTER TABLE seed_structure ADD COLUMN checksum BIGINT;
ALTER TABLE protocol ADD COLUMN checksum BIGINT;
ALTER TABLE decision ADD COLUMN checksum BIGINT;
ALTER TABLE candidate ADD COLUMN checksum BIGINT;
ALTER TABLE candidate ADD COLUMN features_checksum BIGINT;
ALTER TABLE candidate ADD COLUMN selector_checksum BIGINT;
ALTER TABLE candidate ADD COLUMN original_checksum BIGINT;
ALTER TABLE component ADD COLUMN checksum BIGINT;
ALTER TABLE walk ADD COLUMN checksum BIGINT;
ALTER TABLE walk ADD COLUMN checkpoint_checksum BIGINT;
ALTER TABLE label ADD COLUMN checksum BIGINT;
ALTER TABLE import ADD COLUMN checksum BIGINT;
ALTER TABLE archive ADD COLUMN checksum BIGINT;

-- A labeller of an earlier version may still be at work. Those that are there get theirs in the same transaction.
ALTER TABLE label ADD CONSTRAINT newer_version_of_calmwalk_needed CHECK (checksum IS NOT NULL) NOT VALID;
