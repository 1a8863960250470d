#!/usr/bin/env bash
# Debian packages the tests use (with `kernel`: and those of `make test-uml`; with `pi`: of `make test-pi`): installed when root or passwordless sudo is there, else named with how to get them.
set -u
missing=()
lean=()  # installed without what Debian recommends beside them: a browser would bring half a desktop
# A browser: in Debian the one without windows, which takes half the processor time.
if ! command -v chromium-headless-shell >/dev/null; then
  whole=$(command -v chromium)
  if apt-cache show chromium-headless-shell >/dev/null 2>&1 && { [ -z "$whole" ] || [ "$(id -u)" -eq 0 ]; }; then
    lean+=(chromium-headless-shell fonts-dejavu-core)
  elif [ -z "$whole" ]; then
    lean+=(chromium fonts-dejavu-core)
  fi
fi
command -v g++ >/dev/null || missing+=(g++)
command -v make >/dev/null || missing+=(make)
command -v gcc >/dev/null || missing+=(gcc libc6-dev)
command -v avr-g++ >/dev/null || missing+=(gcc-avr avr-libc binutils-avr)
[ -d /usr/share/arduino/hardware/arduino/avr/cores/arduino ] || missing+=(arduino-core-avr)
[ -f /usr/include/simavr/sim_avr.h ] || missing+=(libsimavr-dev)
[ -f /usr/include/libelf.h ] || missing+=(libelf-dev)
command -v avrdude >/dev/null || missing+=(avrdude)
command -v arduino-builder >/dev/null || missing+=(arduino-builder)
command -v systemd-analyze >/dev/null || lean+=(systemd)
# The accessibility checker of the operator's page.
[ -d node_modules/axe-core ] || ! command -v npm >/dev/null || npm install --no-save --no-package-lock --silent axe-core >/dev/null 2>&1
if [ "${1-}" = kernel ]; then
  for tool in flex bison bc; do command -v $tool >/dev/null || missing+=($tool); done
  command -v xz >/dev/null || missing+=(xz-utils)
fi
if [ "${1-}" = pi ]; then
  command -v qemu-system-aarch64 >/dev/null || lean+=(qemu-system-arm)
  command -v mmdebstrap >/dev/null || lean+=(mmdebstrap)
  command -v arch-test >/dev/null || lean+=(arch-test)  # mmdebstrap asks it whether programs for ARM run here
  command -v mke2fs >/dev/null || lean+=(e2fsprogs)
  command -v ssh >/dev/null || lean+=(openssh-client)
  [ -e /usr/lib/binfmt.d/qemu-aarch64.conf ] || lean+=(qemu-user-static)
fi
[ ${#missing[@]} -eq 0 ] && [ ${#lean[@]} -eq 0 ] && exit 0
as_root=()
if [ "$(id -u)" -ne 0 ]; then
  if sudo -n true 2>/dev/null; then as_root=(sudo -n); else as_root=(false); fi
fi
if [ "${as_root[0]-}" != false ] && command -v apt-get >/dev/null; then
  echo "installing ${missing[*]} ${lean[*]}"
  "${as_root[@]}" apt-get update -qq >/dev/null 2>&1
  get() { [ $# -eq 1 ] || "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$@" >/dev/null 2>&1; }
  if get --install-recommends "${missing[@]}"; then missing=(); fi
  if get --no-install-recommends "${lean[@]}"; then lean=(); fi
  [ ${#missing[@]} -eq 0 ] && [ ${#lean[@]} -eq 0 ] && exit 0
fi
missing+=("${lean[@]}")
echo "Not installed: ${missing[*]}. The tests that need them are skipped and counted below." >&2
echo "To run them too: sudo apt-get install ${missing[*]}" >&2
