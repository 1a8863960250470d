#!/usr/bin/env bash
# Builds the user-mode Linux of `make test-uml` from Debian's kernel source, once, and prints its path.
# 139 MB are downloaded, about 6 CPU minutes and 2 GB of disk are used; only the kernel (6 MB) is kept. No root needed.
# Where: $POLYSIGHT_UML, else ~/.cache/polysight-uml.
set -euo pipefail
source_package=linux-source-6.1
here=$(cd "$(dirname "$0")" && pwd)
cache=${POLYSIGHT_UML:-${XDG_CACHE_HOME:-$HOME/.cache}/polysight-uml}
kernel=$cache/linux-$(cat "$0" "$here/kernel.config" | sha256sum | cut -c1-12)
if [ -x "$kernel" ]; then echo "$kernel"; exit 0; fi

missing=()
for tool in gcc make flex bison bc; do command -v $tool >/dev/null || missing+=($tool); done
command -v xz >/dev/null || missing+=(xz-utils)
[ -f /usr/include/libelf.h ] || missing+=(libelf-dev)
if [ ${#missing[@]} -gt 0 ]; then
  echo "The kernel cannot be built: not installed: ${missing[*]}. sudo apt-get install ${missing[*]}" >&2
  exit 69
fi

mkdir -p "$cache"
exec 9>"$cache/lock"
flock 9  # two runs at once: the second finds the first one's kernel
if [ -x "$kernel" ]; then echo "$kernel"; exit 0; fi
work=$cache/work
rm -rf "$work"
mkdir "$work"
trap 'rm -rf "$work"' EXIT
{
  cd "$work"
  apt-get download $source_package || { echo "apt has no $source_package: Debian 12 has; see its deb lines" >&2; exit 69; }
  dpkg-deb --fsys-tarfile ./*.deb | tar -xO ./usr/src/$source_package.tar.xz | tar -xJ
  cd $source_package
  # gpio-sim's interrupts need numbers of their own: user-mode Linux counts all 64 of its own as taken.
  sed -i 's/^#define NR_IRQS\t\t\tUM_LAST_SIGNAL_IRQ$/#define NR_IRQS\t\t\t(UM_LAST_SIGNAL_IRQ + 192)/' arch/um/include/asm/irq.h
  grep -q 'UM_LAST_SIGNAL_IRQ + 192' arch/um/include/asm/irq.h
  # ptrace takes the FP registers whole or not at all (EFAULT): up to 11,008 bytes on processors with AMX, where 6.1 has a
  # buffer of 2,696. The larger buffer lies on kernel stacks, hence KERNEL_STACK_ORDER in kernel.config.
  sed -i 's/DEFINE_LONGS(HOST_FP_SIZE, 2696);/DEFINE_LONGS(HOST_FP_SIZE, 12288);/' arch/x86/um/user-offsets.c
  grep -q 'HOST_FP_SIZE, 12288' arch/x86/um/user-offsets.c
  # gpio-sim delivers a simulated edge by irq_work, which waits for the next tick here (user-mode Linux sends itself no interrupt).
  awk '{ print }
       /^#include <linux\/irq.h>/ { print "#include <linux/irq_work.h>"; n++ }
       /__assign_bit\(offset, chip->pull_map, value\);/ { at = NR }
       at && NR == at + 1 && /mutex_unlock/ { print "\tlocal_irq_disable();\n\tirq_work_run();\n\tlocal_irq_enable();"; n++ }
       END { exit n != 2 }' drivers/gpio/gpio-sim.c >gpio-sim.c
  mv gpio-sim.c drivers/gpio/gpio-sim.c
  make -s ARCH=um allnoconfig KCONFIG_ALLCONFIG="$here/kernel.config" O="$work/obj"
  for option in GPIO_SIM UML_TIME_TRAVEL_SUPPORT HOSTFS UNIX98_PTYS TRACING; do grep -q "^CONFIG_$option=y" "$work/obj/.config"; done
  make -s ARCH=um O="$work/obj" -j"$(nproc)" linux
  strip -o "$kernel.new" "$work/obj/linux"
  mv "$kernel.new" "$kernel"
} >&2
echo "$kernel"
