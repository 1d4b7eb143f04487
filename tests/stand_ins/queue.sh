# What the stand-ins for PBS and LSF share: a queue of jobs on this host, in the directory $STAND_IN_QUEUE.
#
# Each job is a directory, named by its number, with the files script, name, output, after (number of the job whose start it waits for)
# and state: PEND, RUN, DONE, EXIT; `begun` is made by who begins or cancels it. While the file `hold` exists, jobs wait; while `full` exists, none is accepted; while `down` exists,
# the batch system does not answer.
queue=${STAND_IN_QUEUE:?}
mkdir -p "$queue"

note() { printf '%s\n' "$*" >> "$queue/calls"; }
state() { cat "$queue/$1/state" 2>/dev/null; }  # nothing for an unknown job
# A state is written by rename, so that nobody reads half of one.
set_state() { echo "$2" > "$queue/$1/state.new" && mv "$queue/$1/state.new" "$queue/$1/state"; }

# new_job NAME OUTPUT AFTER < SCRIPT: sets `number`.
new_job() {
    number=1000
    until mkdir "$queue/$number" 2>/dev/null; do number=$((number + 1)); done
    cat > "$queue/$number/script"
    echo "$1" > "$queue/$number/name"
    echo "$2" > "$queue/$number/output"
    echo "$3" > "$queue/$number/after"
    set_state "$number" PEND
    setsid bash "$(dirname "${BASH_SOURCE[0]}")/run_job.sh" "$number" </dev/null >/dev/null 2>&1 &
}

# end_job NUMBER SIGNAL…: signals every process of the job.
end_job() {
    local job=$1 signal
    shift
    if mkdir "$queue/$job/begun" 2>/dev/null; then
        set_state "$job" EXIT
        return
    fi
    while [ "$(state "$job")" = PEND ]; do sleep 0.01; done
    case $(state "$job") in
        RUN)
            for signal in "$@"; do
                # shellcheck disable=SC2046
                kill -s "$signal" $(ps -o pid= -s "$(cat "$queue/$job/session")") 2>/dev/null
            done
            ;;
    esac
}
