#!/bin/sh
# The instrument and its tools into the virtual environment $2, made with the Python $1: by uv, a third of pip's time, or by
# pip where uv cannot be had.
# Says what it does, and each minute that it still does it; warnings of packages that are none of the user's business stay away.
set -u
python=$1 venv=$2
projects="-e ./shared -e ./pi_controller -e ./simulators -e ./host -e ./papers -e ./worlds"
export PYTHONWARNINGS=ignore PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_QUIET=2 PIP_NO_INPUT=1 PIP_ROOT_USER_ACTION=ignore UV_NO_PROGRESS=1

patiently() {  # COMMAND...: its exit status, and a line for every minute that it takes
  "$@" &
  job=$! seconds=0
  while kill -0 $job 2>/dev/null; do
    sleep 1
    seconds=$((seconds + 1))
    [ $((seconds % 60)) -ne 0 ] || echo "  still installing, minute $((seconds / 60))"
  done
  wait $job
}

echo "installing the instrument and its tools into $venv"
if uv=$(command -v uv); then
  "$uv" venv --quiet --seed --allow-existing --python "$python" "$venv" || exit 2
else
  "$python" -m venv "$venv" || exit 2
  "$venv/bin/python" -m pip install uv 2>/dev/null && uv=$venv/bin/uv
fi
# Not compiled: most modules of SciPy and its like are never imported, those that are compile themselves.
if [ -n "$uv" ] && patiently "$uv" pip install --quiet --python "$venv/bin/python" $projects --group dev; then
  exit 0
fi
echo "without uv, with pip: some minutes"
patiently "$venv/bin/python" -m pip install --upgrade "pip>=25.1" &&
  patiently "$venv/bin/python" -m pip install $projects --group dev
