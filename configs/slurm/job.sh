# What the jobs of a campaign have in common; their scripts source it.

tries=5  # of a command that fails
pause=20 # s between two of them

# work COMMAND …: runs it, hands on the batch system's notice, and ends with its exit code:
#   0    done
#   2    wrong input or configuration: no use in trying again
#   130  stopped in order: the job is requeued and goes on when it is its turn again, unless it was cancelled
#   any other: failed, and tried again; after a notice requeued
work() {
    local try code=130
    told= child=
    trap 'told=yes; [ -z "$child" ] || kill -TERM "$child" 2>/dev/null' TERM
    for ((try = 1; try <= tries; try++)); do
        [ "$try" = 1 ] || doze "$pause"
        [ -z "$told" ] || break
        note "on $SLURMD_NODENAME, restart ${SLURM_RESTART_COUNT:-0}, try $try of $tries: $*"
        "$@" &
        child=$!
        await
        code=$?
        child=
        note "exit code $code"
        case $code in 0 | 2 | 130) break ;; esac
    done
    case $code in
        0 | 2) ;;
        130) requeue ;;
        *) [ -z "$told" ] || requeue ;;
    esac
    return "$code"
}

note() { echo "$(date '+%F %T') job $SLURM_JOB_ID: $*"; }

# Waits for the child, also when the notice comes meanwhile, and gives its exit code.
await() {
    local code before
    while :; do
        before=$told
        wait "$child"
        code=$?
        [ "$told" != "$before" ] || return "$code"
    done
}

# A pause that a notice ends.
doze() {
    sleep "$1" &
    wait $!
}

# Only while the job runs: one that was cancelled, or whose time is over, is not to come back. Slurm ends this script then.
requeue() {
    local try
    for ((try = 1; try <= 12; try++)); do
        case $(squeue --noheader --jobs="$SLURM_JOB_ID" --format=%T 2>/dev/null) in
            RUNNING)
                note "requeued"
                if scontrol requeue "$SLURM_JOB_ID"; then
                    doze 120
                    exit 130
                fi
                ;;
            ?*) return ;;
        esac
        doze 5
    done
    note "could not be requeued: launch the campaign again"
}
