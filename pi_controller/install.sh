#!/usr/bin/env bash
# Installs or updates the Pi half on a Raspberry Pi: `make pi-install HOST=user@address` builds its wheel, copies
# it with this file and runs it there with sudo. May be run again; the rig file and the keys that are there stay.
# The first run fetches the libraries from the internet; later ones need none, unless a release needs another library.
# Not run on hardware yet.
set -euo pipefail
copied=$(cd "$(dirname "$0")" && pwd)
root=${ROOT:-} # another place than /, to try it out
pip="$root/opt/polysight/venv/bin/pip"
export PIP_DISABLE_PIP_VERSION_CHECK=1

python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
  echo "Python 3.11 or newer is needed: Raspberry Pi OS 12 (bookworm) or newer" >&2
  exit 2
}
getent group gpio >/dev/null || groupadd --system gpio
getent passwd polysight >/dev/null ||
  useradd --system --user-group --groups gpio,dialout --no-create-home --shell /usr/sbin/nologin polysight

mkdir -p "$root/opt/polysight" "$root/etc/polysight/keys" "$root/etc/udev/rules.d" "$root/etc/systemd/system"
[ -x "$pip" ] || python3 -m venv "$root/opt/polysight/venv"
"$pip" install --quiet --retries 1 "$copied"/*.whl || {
  echo "A library is missing and cannot be fetched: connect this Pi to the internet once, and run this again." >&2
  exit 5
}
"$pip" install --quiet --no-index --no-deps --force-reinstall "$copied"/*.whl # the same version may have other content
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

echo "Installed. After the first time, on the Pi:"
echo "  edit /etc/polysight/instrument.toml, or copy the host's"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi keys --dir /etc/polysight/keys"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi check --config /etc/polysight/instrument.toml"
echo "  sudo systemctl restart polysight-pi"
