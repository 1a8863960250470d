#!/bin/bash
# First process of user-mode Linux: mounts what a Linux has, runs $PROGRAM with $PYTHON, and halts.
# Both, and PYTHONPATH, come from the kernel's command line. The root is the host's, read-only; /run is the guest's own.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/run TMPDIR=/run LC_ALL=C.UTF-8 PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/pts
mount -t devpts pts /dev/pts
mount -t configfs config /sys/kernel/config
mount -t tracefs trace /sys/kernel/tracing
mount -t tmpfs run /run
cd /run
"$PYTHON" "$PROGRAM" "$ARGUMENT"
echo "guest: ended with status $?"
"$PYTHON" -c 'import ctypes; ctypes.CDLL(None).reboot(0x4321FEDC)'
