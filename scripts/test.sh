#!/usr/bin/env bash
# Run all tests, the slow ones too, in an environment of their own that the first run makes in .venv.
#
#   scripts/test.sh                          everything
#   scripts/test.sh -m "not slow" -k split   arguments go to pytest, and the last -m counts
#
# Tests on real measurements need their folder in DIFFEO_CALIB_DATA, else they are skipped and say so.
set -euo pipefail
# shellcheck source=scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# Two processes with one thread each: most tests are too small for more threads. A file's tests stay together.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
say "running the tests with $("$VENV/bin/python" --version)"
exec "$VENV/bin/python" -m pytest -n 2 --dist loadfile -m "" -rs --durations=10 "$@"
