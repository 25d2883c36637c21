#!/usr/bin/env bash
# Before a release: try the lowest and the newest versions that pyproject.toml allows, with every Python of this machine.
#
#   scripts/versions.sh                     Python 3.10 to 3.14, those that are here
#   scripts/versions.sh python3.10 ...      these
#   DIFFEO_CALIB_TESTS="tests" scripts/versions.sh      other tests than the quick ones
#
# Every environment is new, in a temporary folder, and removed afterwards. An hour, and 10 GB of downloads: uv installs,
# and takes a CPU build of torch where UV_FIND_LINKS or UV_TORCH_BACKEND tell it to. Of a library only releases count
# that have a wheel for the Python: the lowest bounds are those of the oldest Python.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
# One file or more for every library.
QUICK="tests/test_package.py tests/common/test_threads.py tests/flows/test_geodesic.py tests/kernels/test_fused_sums.py \
tests/robots/test_chains.py tests/cameras tests/measurements/test_bags.py tests/measurements/test_table.py \
tests/interop/test_model_file.py tests/interop/test_sklearn.py tests/interop/test_torch_program.py \
tests/interop/test_urdf_export.py tests/cli/test_help.py tests/cli/test_refused_commands.py"
read -ra TESTS <<<"${DIFFEO_CALIB_TESTS:-$QUICK}"
SUM="import torch, diffeo_calib as dc; dc.Gaussian(1.0).using('keops').field(None, *torch.rand(2, 9, 3, dtype=torch.float64))"
WORK="$(mktemp -d)"
trap 'rm -rf "$WORK"' EXIT
export PYTHONPATH="$PWD" OMP_NUM_THREADS=1 UV_HTTP_TIMEOUT=300

pythons=("$@")
if [ $# -eq 0 ]; then
  for minor in 10 11 12 13 14; do
    for candidate in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python; do
      "$candidate" -c "" >/dev/null 2>&1 && pythons+=("$candidate") && break
    done
  done
fi

python3 -m venv "$WORK/uv" && "$WORK/uv/bin/pip" install --quiet uv || exit 1
# A file with a certificate that pip is told of is one for uv too.
[ -z "${PIP_CERT:-}" ] || export SSL_CERT_FILE="$PIP_CERT"
uv() { "$WORK/uv/bin/uv" --quiet "$@"; }

table="Python versions install help keops tests demo"
failed=0
# Run a command with a name, and add to the table whether it succeeded.
try() {
  local log="$WORK/$1.log"
  if "${@:2}" >"$log" 2>&1; then row+=" yes"; else row+=" NO" failed=1; tail -n 40 "$log"; fi
  tail -n 1 "$log"
}
for python in "${pythons[@]}"; do
  for resolution in lowest-direct highest; do
    own="$WORK/own"
    uv venv --clear --python "$("$python" -c 'import sys; print(sys.executable)')" "$own" || exit 1
    row="$("$own/bin/python" -c 'import platform; print(platform.python_version())') $resolution"
    echo "== $row"
    try install uv pip install --python "$own/bin/python" --resolution "$resolution" --only-binary :all: \
      --no-binary pykeops --no-binary keopscore -r pyproject.toml --extra test
    try help "$own/bin/python" -m diffeo_calib fit --help
    try keops "$own/bin/python" -W error -c "$SUM"
    # The oldest libraries warn of what the newest Python will remove.
    try tests "$own/bin/python" -m pytest -o filterwarnings=default -m "not slow" "${TESTS[@]}"
    try demo "$own/bin/python" -m diffeo_calib demo --output "$own/demo"
    table+=$'\n'"$row"
  done
done
column -t <<<"$table"
exit "$failed"
