# Makes .venv beside the scripts and installs bbfit into it; sourced by the other scripts with the extras to install as $1.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if [ ! -x .venv/bin/python ]; then
    python=$(command -v python3.11 || command -v python3 || true)
    [ -n "$python" ] || { echo "Python 3.11 is needed; install it first" >&2; exit 2; }
    "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || {
        echo "Blender as a module needs Python 3.11, and $python is another; install python3.11 and its venv module" >&2
        exit 2
    }
    echo "making .venv"
    "$python" -m venv .venv
fi
echo "installing bbfit[$1] into .venv (the first time takes some minutes)"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[$1]"
[[ $1 != *blender* ]] || .venv/bin/python -c 'import bpy' >/dev/null 2>&1 || {
    echo "Blender does not start; on Debian and Ubuntu it needs:" >&2
    echo "  apt-get install libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1 libegl1 libgomp1" >&2
    exit 2
}
