#!/bin/sh
# Makes the test sets of configs/aluminium.toml, and the frames of cold dynamics that it compares with: molecular dynamics with the
# embedded-atom potential that also makes the labels of that campaign. Usage: configs/data/aluminium_tests/make.sh [CALMWALK]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
program=${1:-calmwalk}
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT

# The seed structures by name.
structure() {
    awk -v name="name=$1" 'NF == 1 && $1 ~ /^[0-9]+$/ { count = $1; getline; if (index($0 " ", name " ")) { print count; print; for (i = 0; i < count; i++) { getline; print } } }' \
        "$here/../aluminium_seeds.extxyz"
}

# Scales the cell and the positions of a file by a factor: scale FACTOR FILE
scale() {
    awk -v f="$1" '
        NR == 1 { print; next }
        NR == 2 {
            match($0, /Lattice="[^"]*"/)
            count = split(substr($0, RSTART + 9, RLENGTH - 10), cell, " ")
            text = ""
            for (i = 1; i <= count; i++) text = text (i > 1 ? " " : "") sprintf("%.10g", f * cell[i])
            print substr($0, 1, RSTART + 8) text substr($0, RSTART + RLENGTH - 1)
            next
        }
        { printf "%s %.10g %.10g %.10g\n", $1, f * $2, f * $3, f * $4 }' "$2"
}

# Frames of dynamics: dynamics NAME START TEMPERATURE STEPS EVERY SEED
dynamics() {
    cat > "$work/md.toml" <<END
structure = "$2"
potential = { kind = "eam_fs", file = "$here/../Al_mm.eam.fs" }
dynamics = { steps = $4, temperature = $3, rng_seed = $6, thermostat = { langevin = { friction = 0.02 } } }
output = { trajectory = "$work/$1.extxyz", every = $5 }
END
    "$program" md "$work/md.toml"
}

# The last N frames of a trajectory, without velocities: last N FROM TO
last() {
    awk -v keep="$1" '
        NF == 1 && $1 ~ /^[0-9]+$/ { frame++; size = $1; header[frame] = $0; getline
            sub(":momenta:R:3", ""); info[frame] = $0
            for (i = 1; i <= size; i++) {
                getline
                atom[frame, i] = sprintf("%s %.8f %.8f %.8f %.8f %.8f %.8f", $1, $2, $3, $4, $5, $6, $7) }
            count[frame] = size }
        END { for (f = frame - keep + 1; f <= frame; f++) { print header[f]; print info[f]
            for (i = 1; i <= count[f]; i++) print atom[f, i] } }' "$work/$2.extxyz" > "$3"
}

for name in fcc-100 vacancy slab-111; do structure $name > "$work/$name.xyz"; done
mv "$work/fcc-100.xyz" "$work/fcc.extxyz"
mv "$work/vacancy.xyz" "$work/vacancy-start.extxyz"
mv "$work/slab-111.xyz" "$work/slab.extxyz"
scale 1.02 "$work/fcc.extxyz" > "$work/hot-start.extxyz"
scale 1.045 "$work/fcc.extxyz" > "$work/liquid-start.extxyz"

dynamics cold "$work/fcc.extxyz" 300 1750 250 11
dynamics hot "$work/hot-start.extxyz" 900 1750 250 12
dynamics vacancy "$work/vacancy-start.extxyz" 700 1750 250 13
dynamics surface "$work/slab.extxyz" 600 1750 250 14
dynamics melt "$work/liquid-start.extxyz" 4000 3000 3000 15
last 1 melt "$work/molten.extxyz"
dynamics liquid "$work/molten.extxyz" 1300 2500 250 16
for name in cold hot vacancy surface liquid; do last 5 $name "$here/$name.extxyz"; done
# Frames every 20 steps: what dynamics of the cold crystal would have labelled instead.
dynamics cold-dynamics "$work/fcc.extxyz" 300 3000 20 17
last 72 cold-dynamics "$here/cold-dynamics.extxyz"
