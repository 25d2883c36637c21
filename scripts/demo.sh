#!/usr/bin/env bash
# Run the demonstration, in an environment of its own that the first run makes in .venv.
#
#   scripts/demo.sh             arguments go to `diffeo-calib demo`
#
# The results go to demo_output/ in the project's root.
set -euo pipefail
EXTRAS="[fused]"
# shellcheck source=scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

OUTPUT=demo_output
say "running the demonstration, about a minute"
"$VENV/bin/diffeo-calib" demo --output "$OUTPUT" "$@"

figures="$(find "$OUTPUT" -type f \( -name '*.html' -o -name '*.png' -o -name '*.pdf' -o -name '*.svg' \) | sort)"
[ -n "$figures" ] || fail "the demonstration wrote neither a report nor a figure in $ROOT/$OUTPUT"
say "done; look at:"
while IFS= read -r figure; do
  printf '     %s\n' "$ROOT/$figure"
done <<<"$figures"
