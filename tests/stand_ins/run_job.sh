# Runs a job of the stand-ins when it may start: run_job.sh NUMBER.
. "$(dirname "${BASH_SOURCE[0]}")/queue.sh"
job=$1
after=$(cat "$queue/$job/after")
while [ -d "$queue" ] && { [ -e "$queue/hold" ] || { [ -n "$after" ] && [ "$(state "$after")" = PEND ]; }; }; do sleep 0.05; done
[ "$(state "$job")" = PEND ] || exit 0
output=$(cat "$queue/$job/output")
# The shell lets background processes ignore SIGINT.
env --default-signal=INT setsid bash "$queue/$job/script" >> "${output:-/dev/null}" 2>&1 </dev/null &
echo $! > "$queue/$job/session"
set_state "$job" RUN
wait $!
code=$?
[ ! -d "$queue/$job" ] || set_state "$job" "$([ "$code" = 0 ] && echo DONE || echo EXIT)"
