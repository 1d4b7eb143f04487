# Shell functions that the job scripts of a campaign source.

tries=5  # attempts of a failing command
pause=20 # time between attempts, s

# work COMMAND …: runs the command, forwards the SIGTERM of the batch system, and returns the exit code of the command:
#   0    done
#   2    invalid input or configuration: not retried
#   130  stopped: the job is requeued, unless it was cancelled, and resumes when it is scheduled again
#   other: failure; retried, or requeued after a SIGTERM
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

# Waits for the child, also if SIGTERM interrupts the wait, and returns its exit code.
await() {
    local code before
    while :; do
        before=$told
        wait "$child"
        code=$?
        [ "$told" != "$before" ] || return "$code"
    done
}

# Sleeps; SIGTERM ends the sleep.
doze() {
    sleep "$1" &
    wait $!
}

# Requeues the job only while Slurm reports it as running, so that a cancelled or timed-out job does not return. Slurm then ends this
# script.
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
