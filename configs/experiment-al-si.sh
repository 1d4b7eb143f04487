#!/bin/sh
# One replicate of the collection experiment in aluminium or silicon: the paper's biased and unbiased collections, upfits with the same
# command, and their errors on sets made here. docs/experiment-al-si.md explains the steps.
# Usage: configs/experiment-al-si.sh al|si REPLICATE DIRECTORY [CALMWALK]
# REPLICATE, a number above 0, is the random seed of everything. EPOCHS is 40 if it is not set. THREADS=1 is right where as many of these as
# there are cores run beside each other.
set -eu
element=$1 replicate=$2
mkdir -p "$3"
out=$(cd "$3" && pwd)
program=${4:-calmwalk}
configs=$(cd "$(dirname "$0")" && pwd)
epochs=${EPOCHS:-40} threads=${THREADS:-2}
case $element in
al) model=al_eam_1l kind=eam_fs potential=Al_mm.eam.fs temperatures="300 500 700 850 1000 1100" liquid=1200 melt=3000
    seeds=aluminium_seeds.extxyz defects=700 ;;
si) model=si_sw_1l kind=stillinger_weber potential=Si.sw temperatures="300 500 900 1200 1500 2000" liquid=2000 melt=5000
    seeds=silicon_seeds.extxyz defects=900 ;;
*) echo "the element is '$element'; expected al or si" >&2; exit 2 ;;
esac
data=$configs/data

# A copy of a configuration with absolute paths and the replicate's random seed: configured FILE NAME
configured() {
    sed -e "s|\"data/|\"$data/|g" -e "s/^rng_seed = [0-9]*/rng_seed = $replicate/" \
        -e "s/^threads_per_walker = [0-9]*/threads_per_walker = $threads/" "$configs/$1" > "$out/$2"
}

# The frames of a trajectory from number FROM (of 0) on, of equally many atoms: frames FROM FILE
frames() {
    lines=$(($(head -n 1 "$2") + 2))
    tail -n +$(($1 * lines + 1)) "$2"
}

# The seed structure of a name.
structure() {
    awk -v name="name=$1" 'NF == 1 && $1 ~ /^[0-9]+$/ { count = $1; getline; if (index($0 " ", name " ")) { print count; print; for (i = 0; i < count; i++) { getline; print } } }' \
        "$data/$seeds"
}

# Dynamics with the potential that makes the labels: dynamics NAME START TEMPERATURE STEPS EVERY SEED [KEYS]
dynamics() {
    [ -e "$out/$1.extxyz" ] && return
    cat > "$out/$1.toml" <<END
structure = "$2"
potential = { kind = "$kind", file = "$data/$potential" }
[dynamics]
steps = $4
temperature = $3
rng_seed = $6
thermostat = { nose_hoover = { relaxation_time = 100.0 } }
${7-}
[output]
trajectory = "$out/$1.partial"
every = $5
log_every = $4
END
    "$program" md "$out/$1.toml"
    mv "$out/$1.partial" "$out/$1.extxyz"
}

# 1. The unbiased collection: 200 frames, 100 at each temperature.
unbiased=$out/unbiased.extxyz
if [ ! -e "$unbiased" ]; then
    for temperature in 300 500; do
        configured "md-$element-$temperature.toml" "md-$temperature.toml"
        "$program" md "$out/md-$temperature.toml" --output "$out/md-$temperature.extxyz" >&2
        # Without the first 4 ps, and without the frame after them.
        frames 11 "$out/md-$temperature.extxyz"
    done > "$out/unbiased.partial"
    mv "$out/unbiased.partial" "$unbiased"
fi

# 2. The biased collection, and its unbiased partner: control walks of the same conditions, as many frames. Up to 50 of each walk.
configured "$element-collect.toml" collect.toml
sed -i 's/^control = false/control = true/' "$out/collect.toml"
"$program" run "$out/collect.toml" --directory "$out/campaign"
for origin in biased control; do
    "$program" export "$out/campaign" --control --where "origin = $origin" --per-walk 50 --draw-rng-seed "$replicate" \
        --output "$out/$origin.extxyz"
done

# 3. The sets of the judgement: crystals at six temperatures, the liquid, the (111) surface and the vacancy, with random seeds of their own.
barostat='barostat = { pressure = 1.0 }'
sets=
for temperature in $temperatures; do
    dynamics "run-$temperature" "$data/$model/seed_frames.extxyz" "$temperature" 12000 500 $((1000 + replicate)) "$barostat"
    frames 5 "$out/run-$temperature.extxyz" > "$out/set-$temperature.extxyz"
    sets="$sets $temperature"
done
for defect in slab-111 vacancy; do
    structure $defect > "$out/$defect-start.extxyz"
done
# The slab has no volume that a pressure could act on, and the melt would boil at 1 bar.
dynamics run-surface "$out/slab-111-start.extxyz" $defects 12000 500 $((1100 + replicate))
dynamics run-vacancy "$out/vacancy-start.extxyz" $defects 12000 500 $((1200 + replicate)) "$barostat"
dynamics run-melt "$data/$model/seed_frames.extxyz" $melt 6000 6000 $((1300 + replicate))
frames 1 "$out/run-melt.extxyz" > "$out/molten.extxyz"
dynamics run-liquid "$out/molten.extxyz" $liquid 12000 500 $((1400 + replicate)) "$barostat"
for set in surface vacancy liquid; do
    frames 5 "$out/run-$set.extxyz" > "$out/set-$set.extxyz"
    sets="$sets $set"
done

# 4. Upfits with the same command: the 50 frames of the potential and one of the collections.
for collection in unbiased control biased; do
    [ -e "$out/upfit-$collection.npz" ] && continue
    "$program" upfit --model "$data/$model/kokkos.npz" "$data/$model/seed_frames.extxyz" "$out/$collection.extxyz" \
        --validation-share 0 --optimiser soap --learning-rate 0.05 --epochs "$epochs" --threads "$threads" --rng-seed "$replicate" --output "$out/upfit-$collection.npz"
    "$program" calm build --model "$out/upfit-$collection.npz" "$data/$model/seed_frames.extxyz" "$out/$collection.extxyz" \
        --candidates 1 --output "$out/mixture-$collection.npz"
done

# 5. Errors and grades on each set: one JSON for each potential and set.
for collection in seed unbiased control biased; do
    tuned=$out/upfit-$collection.npz mixture=$out/mixture-$collection.npz
    [ $collection = seed ] && tuned=$data/$model/kokkos.npz mixture=$data/$model/gmm_artifacts.npz
    for set in $sets; do
        "$program" calm score --model "$tuned" --artifact "$mixture" "$out/set-$set.extxyz" --output "$out/graded-$collection-$set.extxyz" \
            --json "$out/errors-$collection-$set.json" > "$out/errors-$collection-$set.txt"
    done
done
