# Shared by test.sh and demo.sh: `source` it. Prepares .venv in the project's root and changes to that root.
#
#   DIFFEO_CALIB_TORCH    another requirement for torch, e.g. "torch==2.13.0+cu130" (default: a CPU build)
#   DIFFEO_CALIB_PYTHON   the Python to make .venv with (default: the first one that is new enough)
# shellcheck shell=bash
set -euo pipefail

DEFAULT_TORCH="torch==2.13.0"
CPU_WHEELS="https://download.pytorch.org/whl/cpu"
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
STAMP="$VENV/installed"

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

pip_install() { "$VENV/bin/python" -m pip install --disable-pip-version-check "$@"; }

# On Linux the torch of the ordinary index brings gigabytes of CUDA libraries. So the folder of CPU builds is
# offered as one more place to look: of all places pip takes the highest version, and 2.13.0+cpu is higher than 2.13.0.
# Where that folder cannot be reached, pip passes over it at once (no retries) and takes what it has: its ordinary
# index, a mirror, or a local folder of wheels. --no-deps: the other dependencies come with the package itself.
install_torch() {
  if [ -n "${DIFFEO_CALIB_TORCH:-}" ]; then
    pip_install "$DIFFEO_CALIB_TORCH"
  elif has_torch; then
    say "torch is installed already"
  elif [ "$(uname -s)" = Linux ]; then
    pip_install --no-deps --retries 0 --timeout 15 --extra-index-url "$CPU_WHEELS" "$DEFAULT_TORCH" ||
      pip_install "$DEFAULT_TORCH"
  else
    pip_install "$DEFAULT_TORCH"
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
  say "installing into .venv (the largest part, torch, is about 200 MB)"
  install_torch
  pip_install --quiet --editable ".[test]"
  fingerprint >"$STAMP"
}

setup
