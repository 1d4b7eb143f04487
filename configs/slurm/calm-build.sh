#!/bin/bash
# Submits the build of a CALM mixture to Slurm: for each of the three passes an array of jobs, one for each part, and a job that
# merges them. See docs/calm-build.md.
#
#   calm-build.sh PARTS [SBATCH OPTIONS] -- --model kokkos.npz train.extxyz.zst --output gmm_artifacts.npz [OPTIONS OF calm build]
#
# After a failure, the same command submits what is left. The directory must be one that all nodes share. CALMWALK names the program
# if it is not in the PATH.
set -euo pipefail

usage() {
    sed -n '2,/^$/s/^# \{0,1\}//p; /^set/q' "$0" >&2
    exit 2
}

parts=${1:-}
[[ $parts =~ ^[1-9][0-9]*$ ]] || usage
shift
options=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
    options+=("$1")
    shift
done
[ $# -gt 1 ] || usage
shift
# What `calm build` is told, and what `calm merge` must be told, too. Only the last merge updates the mixture by a campaign.
build=()
merge=()
output=
while [ $# -gt 0 ]; do
    name=$1 given=("$1")
    case $1 in
        --model=* | --output=* | --embed=* | --feature-variant=* | --campaign=*) name=${1%%=*} value=${1#*=} ;;
        --model | --output | --embed | --feature-variant | --campaign | -o)
            [ $# -gt 1 ] || usage
            value=$2
            given+=("$2")
            shift
            ;;
        -o?*)
            name=-o value=${1#-o}
            value=${value#=}
            ;;
        *) name= ;;
    esac
    [ "$name" = --campaign ] || build+=("${given[@]}")
    [ -z "$name" ] || merge+=("$name" "$value")
    case $name in --output | -o) output=$value ;; esac
    shift
done
[ -n "$output" ] || usage
program=$(command -v "${CALMWALK:-calmwalk}")
functions=$(cat "$(dirname "$0")/job.sh")

# submit NAME SBATCH-OPTIONS… -- COMMAND: prints the id of the job.
submit() {
    local name=$1 own=()
    shift
    while [ "$1" != -- ]; do
        own+=("$1")
        shift
    done
    shift
    sbatch --parsable --job-name="$name" --requeue --open-mode=append --output=%x-%j.log --signal=B:TERM@60 \
        --kill-on-invalid-dep=yes "${options[@]}" "${own[@]}" <<SCRIPT
#!/bin/bash
$functions
work $(printf '%q ' "$program") $*
SCRIPT
}

# Passes that are merged already are not submitted again.
first=1
[ ! -e "$output.build/partition" ] || first=2
[ ! -e "$output.build/end-2" ] || first=3
after=()
for ((pass = first; pass <= 3; pass++)); do
    array=$(submit "calm-pass-$pass" "${after[@]}" --array="1-$parts" -- calm build "$(printf '%q ' "${build[@]}")" \
        --pass "$pass" --part "\"\$SLURM_ARRAY_TASK_ID/$parts\"")
    merged=$(submit "calm-merge-$pass" --dependency="afterok:$array" -- calm merge "$(printf '%q ' "${merge[@]}")")
    echo "pass $pass: $parts parts in job $array, merged by job $merged"
    after=(--dependency="afterok:$merged")
done
