#!/bin/sh
# Trains the next version of a potential with gracemaker (tensorpotential 0.6.2), as the program of [refit] method = { command = … }
# (docs/refit.md). `gracemaker`, `grace_utils` and a Python with ASE must be in PATH.
#
# LINEAGE is the folder with gracemaker's checkpoints, each under the hash of the export that belongs to it. File that of version 0
# before the campaign:
#
#   folder=lineage/$(sha256sum kokkos.npz | cut -c1-64)
#   mkdir -p "$folder" && cp model.yaml checkpoint.* "$folder"
set -eu

: "${LINEAGE:?the folder with checkpoints}"
: "${EPOCHS:=50}"             # passes over the training set
: "${LEARNING_RATE:=0.0005}"  # at the start; falls to a hundredth on a cosine
: "${BATCH_SIZE:=8}"
: "${CUTOFF:=6.5}"            # Å, that of the model

parent=$LINEAGE/$(sha256sum "$CALMWALK_PARENT_MODEL" | cut -c1-64)
test -e "$parent/model.yaml" || { echo "no checkpoint of $CALMWALK_PARENT_MODEL in $LINEAGE" >&2; exit 1; }

# Only what ASE's calculator holds: energy, forces and stress.
python3 - <<'END'
import os
from ase.io import read, write

def frames(paths):
    for path in filter(None, paths):
        for atoms in read(path, ":"):
            if atoms.calc is None:
                raise SystemExit(f"{path}: a frame without energy and forces where ASE reads them")
            atoms.info = {}
            yield atoms

replay = os.environ["CALMWALK_REPLAY"].split(":")
write("train.both.extxyz", list(frames([os.environ["CALMWALK_TRAIN"], *replay])))
END

cat > input.yaml <<END
seed: $CALMWALK_RNG_SEED
cutoff: $CUTOFF
data: { filename: train.both.extxyz, test_size: 0.1, reference_energy: 0, stress_units: eV/A3 }
potential: { filename: $parent/model.yaml, checkpoint_name: $parent/checkpoint, param_dtype: float64 }
fit:
  loss:
    energy: { type: huber, weight: 20, delta: 0.01 }
    forces: { type: huber, weight: 5, delta: 0.01 }
    stress: { type: huber, weight: 20, delta: 0.01 }
  optimizer: Adam
  opt_params: { learning_rate: $LEARNING_RATE, amsgrad: True }
  scheduler: cosine_decay
  scheduler_params: { minimum_learning_rate: $(awk "BEGIN { printf \"%.12f\", $LEARNING_RATE / 100 }"), resume_lr: False }
  reset_epoch_and_step: True
  reset_optimizer: True
  maxiter: $EPOCHS
  batch_size: $BATCH_SIZE
  progressbar: False
END
rm -rf seed
gracemaker input.yaml

# The epoch with the best test error.
trained=seed/$CALMWALK_RNG_SEED
checkpoint=$trained/checkpoints/checkpoint.best_test_loss
grace_utils -p "$trained/model.yaml" -c "$checkpoint" export_kokkos -o export.npz

folder=$LINEAGE/$(sha256sum export.npz | cut -c1-64)
mkdir -p "$folder"
cp "$trained/model.yaml" "$folder"
for part in index data-00000-of-00001; do
    cp "$checkpoint.$part" "$folder/checkpoint.$part"
done
mv export.npz model.npz
