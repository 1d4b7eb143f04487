#!/bin/bash
# What a job of a campaign runs, written by calmwalk launch: its command, which is asked to stop before the time limit, after which the
# job is submitted again. See docs/batch-systems.md. Exit codes of the command:
#   0      done
#   2      invalid input or configuration: not retried
#   130    stopped: the job is submitted again, unless it was cancelled
#   other  failure; retried
tries=5       # attempts of a failing command
pause=20      # time between attempts, s
limit={limit} # time after which the command is asked to stop, s; 0: never
export CALMWALK_JOB={role}
exec >> {log} 2>&1

note() { echo "$(date '+%F %T') {role}: $*"; }
is_due() { [ "$limit" != 0 ] && [ "$SECONDS" -ge "$limit" ]; }

# Signals come from the batch system, which cancels the job.
told='' child='' interrupted='' code=130
trap 'is_due || told=yes; interrupted=yes; [ -z "$child" ] || kill -TERM "$child" 2>/dev/null' TERM INT

# Runs a command and sets `code`.
attempt() {
    local left=0
    [ "$limit" = 0 ] || left=$((limit > SECONDS ? limit - SECONDS : 1))
    timeout --foreground --preserve-status --signal=TERM "$left" "$@" &
    child=$!
    [ -z "$told" ] || kill -TERM "$child" 2>/dev/null
    while :; do
        interrupted=''
        wait "$child"
        code=$?
        [ -n "$interrupted" ] || break
    done
    child=''
}

# Sleeps; a signal ends the sleep.
doze() {
    sleep "$1" &
    wait $!
}

for ((try = 1; try <= tries; try++)); do
    [ "$try" = 1 ] || doze "$pause"
    [ -z "$told" ] || break
    note "on $(hostname), try $try of $tries: "{command}
    attempt {command}
    note "exit code $code"
    case $code in 0 | 2 | 130) break ;; esac
    ! is_due || break
done
if [ -z "$told" ] && { [ "$code" = 130 ] || { is_due && [ "$code" != 0 ] && [ "$code" != 2 ]; }; }; then
    if {resubmit}; then
        exit 130
    fi
    note "could not be submitted again: launch the campaign again"
fi
{finally}
exit "$code"
