# Runs a job of the stand-ins when it may start: run_job.sh NUMBER.
. "$(dirname "${BASH_SOURCE[0]}")/queue.sh"
job=$1
after=$(cat "$queue/$job/after")
while [ -d "$queue" ] && { [ -e "$queue/hold" ] || { [ -n "$after" ] && [ "$(state "$after")" = PEND ]; }; }; do sleep 0.05; done
# Either it begins, or it was cancelled before.
mkdir "$queue/$job/begun" 2>/dev/null || exit 0
output=$(cat "$queue/$job/output")
# The shell lets background processes ignore SIGINT.
env --default-signal=INT setsid bash "$queue/$job/script" >> "${output:-/dev/null}" 2>&1 </dev/null &
session=$!
echo "$session" > "$queue/$job/session"
# Who cancels a running job signals its session.
while kill -0 "$session" 2>/dev/null && [ -z "$(ps -o pid= -s "$session")" ]; do sleep 0.01; done
set_state "$job" RUN
wait "$session"
code=$?
[ ! -d "$queue/$job" ] || set_state "$job" "$([ "$code" = 0 ] && echo DONE || echo EXIT)"
