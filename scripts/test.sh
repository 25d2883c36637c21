#!/usr/bin/env bash
# Run all tests, the slow ones too, in an environment of their own that the first run makes in .venv.
#
#   scripts/test.sh                          everything
#   scripts/test.sh -m "not slow" -k split   arguments go to pytest, and the last -m counts
#
# Tests on real measurements need their folder in DIFFEO_CALIB_DATA, else they are skipped and say so.
set -euo pipefail
EXTRAS="[test]"
# shellcheck source=scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

say "running the tests with $("$VENV/bin/python" --version)"
exec "$VENV/bin/python" -m pytest -m "" -rs --durations=10 "$@"
