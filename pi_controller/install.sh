#!/usr/bin/env bash
# Installs or updates the Pi half on a Raspberry Pi: `make pi-install HOST=user@address` builds its wheel, copies
# it with this file and runs it there with sudo. May be run again; the rig file and the keys that are there stay.
# The first run fetches the libraries from the internet, in the versions of requirements.txt; later ones need none, unless
# a release needs another library. Each release has a folder of its own, /opt/polysight/releases/N, and
# /opt/polysight/venv is a link to the one in use: `install.sh --roll-back` goes back to the one before it.
# Run in a simulated Pi (make test-pi), not on hardware yet.
set -euo pipefail
copied=$(cd "$(dirname "$0")" && pwd)
root=${ROOT:-} # another place than /, to try it out
opt="$root/opt/polysight"
export PIP_DISABLE_PIP_VERSION_CHECK=1

if [ "${1:-}" = --any-machine ]; then # a board that is not a Raspberry Pi
  shift
elif [ -z "$root" ] && ! grep -qsa '^Raspberry Pi' /proc/device-tree/model; then
  echo "This is not a Raspberry Pi, nothing was changed. For another board: sudo $0 --any-machine" >&2
  exit 2
fi

use() { # make a release the one in use, in one step
  ln -sfn "releases/$1" "$opt/venv.new"
  mv -T "$opt/venv.new" "$opt/venv"
}
in_use() { basename "$(readlink "$opt/venv")"; }

if [ "${1:-}" = --roll-back ]; then
  before=$(find "$opt/releases" -mindepth 1 -maxdepth 1 -printf '%f\n' | sort -n | awk -v n="$(in_use)" '$1 < n' | tail -n 1)
  [ -n "$before" ] || { echo "There is no release before the one in use." >&2; exit 5; }
  use "$before"
  systemctl try-restart polysight-pi
  echo "Release $before is in use again."
  exit
fi

python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
  echo "Python 3.11 or newer is needed: Raspberry Pi OS 12 (bookworm) or newer" >&2
  exit 2
}
for group in gpio spi; do
  getent group "$group" >/dev/null || groupadd --system "$group"
done
getent passwd polysight >/dev/null ||
  useradd --system --user-group --groups gpio,spi,dialout --no-create-home --shell /usr/sbin/nologin polysight

mkdir -p "$opt/releases" "$root/etc/polysight/keys" "$root/etc/udev/rules.d" "$root/etc/systemd/system"
if [ -d "$opt/venv" ] && [ ! -L "$opt/venv" ]; then # installed before there were releases
  mv "$opt/venv" "$opt/releases/0"
  use 0
fi
# A release that has this file was begun and never finished: the power was cut, or the run was ended.
find "$opt/releases" -mindepth 2 -maxdepth 2 -name not-finished -printf '%h\n' | while read -r broken; do rm -rf "$broken"; done
last=$(find "$opt/releases" -mindepth 1 -maxdepth 1 -name '[0-9]*' -printf '%f\n' | sort -n | tail -n 1)
new="$opt/releases/$((${last:-0} + 1))"
rm -rf "$opt/releases/unfinished"
if [ -n "$last" ]; then
  cp -a "$opt/venv/." "$opt/releases/unfinished" # with its libraries
else
  python3 -m venv "$opt/releases/unfinished"
fi
touch "$opt/releases/unfinished/not-finished"
mv "$opt/releases/unfinished" "$new"
python="$new/bin/python"
"$python" -m pip install --quiet --retries 1 --constraint "$copied/requirements.txt" "$copied"/*.whl || {
  rm -rf "$new"
  echo "A library is missing and cannot be fetched: connect this Pi to the internet once, and run this again." >&2
  exit 5
}
# The same version may have other content.
"$python" -m pip install --quiet --no-index --no-deps --force-reinstall "$copied"/*.whl
rm "$new/not-finished"
sync --file-system "$new" # on the card before it is used: the power may be cut at any time
use "$(basename "$new")"
find "$opt/releases" -mindepth 1 -maxdepth 1 -name '[0-9]*' -printf '%f\n' | sort -n | head -n -3 |
  while read -r old; do rm -rf "${opt:?}/releases/$old"; done # three are kept

[ -e "$root/etc/polysight/instrument.toml" ] || cp "$copied/instrument.toml" "$root/etc/polysight/instrument.toml"
chown polysight: "$root/etc/polysight/keys"
chmod 700 "$root/etc/polysight/keys"

cp "$copied/60-polysight.rules" "$root/etc/udev/rules.d/"
udevadm control --reload
udevadm trigger
cp "$copied/polysight-pi.service" "$root/etc/systemd/system/"
systemctl daemon-reload
systemctl enable polysight-pi
systemctl try-restart polysight-pi # a running one goes on with the new release; one that is not running stays so

echo "Installed as release $(in_use); back to the one before: sudo $0 --roll-back. After the first time, on the Pi:"
echo "  edit /etc/polysight/instrument.toml, or copy the host's"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi keys --dir /etc/polysight/keys"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi check --config /etc/polysight/instrument.toml"
echo "  sudo systemctl restart polysight-pi"
