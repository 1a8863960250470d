#!/usr/bin/env bash
# Installs or updates the Pi half on a Raspberry Pi: `make pi-install HOST=user@address` copies the sources and runs this
# there with sudo. May be run again; the rig file and the keys that are there stay. Not run on hardware yet.
set -euo pipefail
sources=$(cd "$(dirname "$0")/.." && pwd)
root=${ROOT:-} # another place than /, to try it out

python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
  echo "Python 3.11 or newer is needed: Raspberry Pi OS 12 (bookworm) or newer" >&2
  exit 2
}
getent group gpio >/dev/null || groupadd --system gpio
getent passwd polysight >/dev/null ||
  useradd --system --user-group --groups gpio,dialout --no-create-home --shell /usr/sbin/nologin polysight

mkdir -p "$root/opt/polysight" "$root/etc/polysight/keys" "$root/etc/udev/rules.d" "$root/etc/systemd/system"
python3 -m venv "$root/opt/polysight/venv"
"$root/opt/polysight/venv/bin/pip" install --quiet --upgrade "$sources/shared" "$sources/pi_controller"
[ -e "$root/etc/polysight/instrument.toml" ] || cp "$sources/instrument.toml" "$root/etc/polysight/instrument.toml"
chown polysight: "$root/etc/polysight/keys"
chmod 700 "$root/etc/polysight/keys"

cp "$sources/pi_controller/60-polysight.rules" "$root/etc/udev/rules.d/"
udevadm control --reload
udevadm trigger
cp "$sources/pi_controller/polysight-pi.service" "$root/etc/systemd/system/"
systemctl daemon-reload
systemctl enable polysight-pi

echo "Installed. Next, on the Pi:"
echo "  edit /etc/polysight/instrument.toml, or copy the host's"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi keys --dir /etc/polysight/keys"
echo "  sudo -u polysight /opt/polysight/venv/bin/polysight-pi check --config /etc/polysight/instrument.toml"
echo "  sudo systemctl restart polysight-pi"
