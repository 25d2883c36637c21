# Shared by test.sh and demo.sh: `source` it. Prepares .venv in the project's root and changes to that root.
#
# EXTRAS, set before, names extras of the package, such as "[test]"; none by default.
#
#   DIFFEO_CALIB_TORCH    another requirement for torch, e.g. "torch==2.13.0+cu130" (default: see install_torch)
#   DIFFEO_CALIB_PYTHON   the Python to make .venv with (default: the first one that is new enough)
# shellcheck shell=bash
set -euo pipefail

DEFAULT_TORCH="torch==2.13.0"
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
EXTRAS="${EXTRAS:-}"
STAMP="$VENV/installed$EXTRAS"

say() { printf '== %s\n' "$*"; }

fail() {
  printf 'error: %s\n' "$*" >&2
  exit 1
}

# Print the first Python >= 3.10 that can make a virtual environment.
find_python() {
  local candidate
  for candidate in ${DIFFEO_CALIB_PYTHON:-python3 python3.13 python3.12 python3.11 python3.10 python3.14 python}; do
    if "$candidate" -c 'import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  fail "no Python >= 3.10 with the venv module found: install one (Debian, Ubuntu: apt install python3-venv)," \
    "or name it: DIFFEO_CALIB_PYTHON=/path/to/python $0"
}

# What the installation depends on; when it is the same as in the stamp, there is nothing to install.
# The root is part of it because an editable installation remembers the folder.
fingerprint() {
  printf '%s\n' "$ROOT" "${DIFFEO_CALIB_TORCH:-$DEFAULT_TORCH}"
  cksum <"$ROOT/pyproject.toml"
}

has_torch() {
  "$VENV/bin/python" -W ignore - 2>/dev/null <<'PYTHON'
import sys
from importlib.metadata import version

sys.exit(tuple(int(part) for part in version("torch").split(".")[:2]) < (2, 6))
PYTHON
}

pip_install() { "$VENV/bin/python" -m pip install --disable-pip-version-check --quiet "$@"; }

# One exact version, and before the package: a range could bring another build. pip takes a CPU build of it where one is
# offered (a local wheel, a mirror, or an index named in PIP_EXTRA_INDEX_URL). Elsewhere on Linux it is the ordinary
# build, which works as well but carries gigabytes of CUDA libraries.
install_torch() {
  if [ -z "${DIFFEO_CALIB_TORCH:-}" ] && has_torch; then
    say "torch is installed already"
  else
    say "installing torch (a download of 0.2 GB, or several GB with CUDA)"
    pip_install "${DIFFEO_CALIB_TORCH:-$DEFAULT_TORCH}"
  fi
}

# False when it is missing, broken, or left half-made.
has_venv() {
  "$VENV/bin/python" -c 'import pip, sys; sys.exit(sys.prefix == sys.base_prefix)' >/dev/null 2>&1
}

make_venv() {
  local python
  python="$(find_python)"
  say "making .venv with $("$python" --version)"
  "$python" -m venv --clear "$VENV"
}

setup() {
  cd "$ROOT"
  if [ -x "$VENV/bin/python" ] && [ "$(cat "$STAMP" 2>/dev/null)" = "$(fingerprint)" ]; then
    return
  fi
  has_venv || make_venv
  install_torch
  say "installing diffeo_calib$EXTRAS and what it needs"
  pip_install --editable ".$EXTRAS"
  fingerprint >"$STAMP"
}

setup
