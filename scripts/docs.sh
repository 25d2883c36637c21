#!/usr/bin/env bash
# Build the documentation, in an environment of its own that the first run makes in .venv.
#
#   scripts/docs.sh             writes docs_output/ in the project's root; arguments go to `mkdocs build`
set -euo pipefail
EXTRAS="[docs]"
# shellcheck source=scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

say "building the documentation"
NO_MKDOCS_2_WARNING=1 "$VENV/bin/python" -m mkdocs build --strict --quiet --config-file scripts/docs/mkdocs.yml "$@"
say "done; open $ROOT/docs_output/index.html"
