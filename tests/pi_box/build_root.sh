#!/usr/bin/env bash
# Builds the Debian of `make test-pi`, once, and prints its folder: a card image (root.img), Debian's arm64 kernel, its
# initial RAM disk, the device tree of a Raspberry Pi 3B, and a key for ssh (user pi, who may use sudo).
# The libraries' wheels for arm64 are in the image, in the versions of pi_controller/requirements.txt; the instrument is not.
# Some 150 MB are downloaded, 1 GB of disk is used, and it takes 6 to 10 minutes of one core. Root is needed.
# Where: $POLYSIGHT_PI_BOX, else ~/.cache/polysight/pi-box. PYTHON: whose pip downloads the wheels.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
pins=$here/../../pi_controller/requirements.txt
cache=${POLYSIGHT_PI_BOX:-${XDG_CACHE_HOME:-$HOME/.cache}/polysight/pi-box}
box=$cache/$(cat "$0" "$pins" | sha256sum | cut -c1-12)
if [ -e "$box/root.img" ]; then echo "$box"; exit 0; fi

missing=()
for program in mmdebstrap mke2fs:e2fsprogs ssh-keygen:openssh-client; do
  command -v "${program%:*}" >/dev/null || missing+=("${program#*:}")
done
registration=/usr/lib/binfmt.d/qemu-aarch64.conf # lets this computer run the packages' arm64 programs while they are installed
[ -e $registration ] || missing+=(qemu-user-static)
if [ ${#missing[@]} -gt 0 ]; then
  echo "The Pi's Debian cannot be built: not installed: ${missing[*]}. sudo apt-get install ${missing[*]}" >&2
  exit 69
fi
[ "$(id -u)" -eq 0 ] || { echo "The Pi's Debian is built by root: sudo PYTHON=.venv/bin/python POLYSIGHT_PI_BOX=$cache $0" >&2; exit 69; }

mkdir -p "$cache"
exec 9>"$cache/lock"
flock 9 # two runs at once: the second finds the first one's
if [ -e "$box/root.img" ]; then echo "$box"; exit 0; fi
work=$cache/work
rm -rf --one-file-system "$work"
mkdir -p "$work/box" "$work/wheels"
trap 'rm -rf --one-file-system "$work"' EXIT  # /proc and /sys are mounted in it if mmdebstrap was killed

libraries() { # $1: a release as install.sh would begin one, with its libraries: an emulated processor takes long over pip
  "${PYTHON:-python3}" -m pip download "${for_the_pi[@]}" --dest "$work/wheels" --requirement "$pins"
  "${PYTHON:-python3}" -m pip install "${for_the_pi[@]}" --target "$1/lib/python3.11/site-packages" --requirement "$pins" pip setuptools
  rm -rf "$1/lib/python3.11/site-packages/bin"
  mkdir "$1/bin"
  ln -s /usr/bin/python3 "$1/bin/python3"
  ln -s python3 "$1/bin/python"
  ln -s lib "$1/lib64"
  printf 'home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11.2\n' >"$1/pyvenv.cfg"
}

customize() { # $1: the root
  install -d -m 755 "$1/opt/wheels" "$1/etc/systemd/network"
  cp "$work"/wheels/*.whl "$1/opt/wheels/"
  install -d -m 755 "$1/opt/polysight/releases"
  cp -a "$work/release" "$1/opt/polysight/releases/0"
  ln -s releases/0 "$1/opt/polysight/venv"
  printf '[global]\nno-index = true\nfind-links = /opt/wheels\n' >"$1/etc/pip.conf"
  echo pibox >"$1/etc/hostname"
  printf '127.0.0.1 localhost\n127.0.1.1 pibox\n' >"$1/etc/hosts"
  printf '[Match]\nType=ether\n[Network]\nDHCP=ipv4\n' >"$1/etc/systemd/network/usb.network"
  # Drivers of what QEMU lacks: one crashes, the others take their time. cdc_subset takes QEMU's network from cdc_ether.
  printf 'blacklist %s\n' cdc_subset vchiq bcm2835_v4l2 snd_bcm2835 hci_uart btbcm >"$1/etc/modprobe.d/box.conf"
  cat /proc/sys/kernel/random/uuid | tr -d - >"$1/etc/machine-id"
  chroot "$1" useradd --create-home --shell /bin/bash pi
  echo 'pi ALL=(ALL) NOPASSWD: ALL' >"$1/etc/sudoers.d/pi"
  install -D -m 644 "$work/box/key.pub" "$1/home/pi/.ssh/authorized_keys"
  chroot "$1" chown -R pi: /home/pi/.ssh
  chroot "$1" systemctl enable systemd-networkd ssh
  chroot "$1" systemctl mask apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer \
    e2scrub_reap.service fstrim.timer getty@tty1.service serial-getty@ttyAMA0.service systemd-logind.service
  touch "$1/etc/.updated" "$1/var/.updated" # up to date: nothing to be made anew at the first start
  cp "$1"/boot/vmlinuz-* "$work/box/vmlinuz"
  cp "$1"/boot/initrd.img-* "$work/box/initrd"
  cp "$1"/usr/lib/linux-image-*/broadcom/bcm2837-rpi-3-b.dtb "$work/box/pi.dtb"
}

{
  for_the_pi=(--quiet --disable-pip-version-check --no-deps --only-binary=:all: --python-version 3.11 --implementation cp)
  for_the_pi+=(--platform manylinux2014_aarch64 --platform manylinux_2_28_aarch64)
  libraries "$work/release"
  ssh-keygen -q -t ed25519 -N '' -C pi-box -f "$work/box/key"
  if [ ! -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ]; then
    [ -e /proc/sys/fs/binfmt_misc/register ] || mount -t binfmt_misc none /proc/sys/fs/binfmt_misc
    cat $registration >/proc/sys/fs/binfmt_misc/register
  fi
  left_out=()
  for part in doc man locale; do left_out+=(--dpkgopt="path-exclude=/usr/share/$part/*"); done
  for part in drivers/gpu drivers/media drivers/infiniband drivers/net/wireless drivers/net/ethernet drivers/scsi sound; do
    left_out+=(--dpkgopt="path-exclude=/lib/modules/*/kernel/$part/*")
  done
  # As a file: a shell between here and there (dash) drops exported functions.
  { echo 'set -euo pipefail'; declare -f customize; echo 'customize "$1"'; } >"$work/customize"
  export work
  # The card's driver and what it needs, instead of every driver there is: the RAM disk is unpacked by an emulated processor.
  mmdebstrap --arch=arm64 --variant=minbase \
    --include=systemd-sysv,udev,kmod,procps,openssh-server,sudo,python3-venv,linux-image-arm64,initramfs-tools,zstd,gpiod \
    --aptopt='Acquire::Languages "none"' --aptopt='APT::Install-Recommends "false"' --dpkgopt=force-unsafe-io "${left_out[@]}" \
    --setup-hook='mkdir -p "$1/etc/initramfs-tools/conf.d" "$1/usr/share/initramfs-tools/modules.d"' \
    --setup-hook='echo MODULES=list >"$1/etc/initramfs-tools/conf.d/box"' \
    --setup-hook='printf "%s\n" bcm2835 bcm2835_dma sdhci_iproc mmc_block ext4 >"$1/usr/share/initramfs-tools/modules.d/box"' \
    --customize-hook='bash "$work/customize" "$1"' \
    bookworm "$work/root" http://deb.debian.org/debian
  truncate -s 2G "$work/box/root.img"
  mke2fs -q -t ext4 -E root_owner=0:0 -d "$work/root" "$work/box/root.img"
  rm -rf "$box"
  mv "$work/box" "$box"
} >&2
echo "$box"
