# A launcher: runs the words after it.
exec "$@"
