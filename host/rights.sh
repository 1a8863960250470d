#!/bin/sh
# Give a user the rights that receiving without loss needs: sudo host/rights.sh USER
# Real-time priority and nice for logins (pam_limits) and for desktop sessions, whose programs are started by
# systemd's user manager and do not read limits.d; the receive buffers; the radars' USB chips. Log out and in after it.
set -eu
user=${1:-}
root=${ROOT:-}
case $user in
'' | *[!A-Za-z0-9._-]*) echo "rights.sh: give the name of the user who scans" >&2; exit 2 ;;
esac
write() {
    mkdir -p "$root$(dirname "$1")"
    cat >"$root$1"
}
write /etc/security/limits.d/60-polysight.conf <<END
# polysight: receivers go before all other programs
$user - rtprio 10
$user - nice -10
END
write /etc/systemd/system/user@.service.d/60-polysight.conf <<END
# polysight: the same for programs started from a desktop
[Service]
LimitRTPRIO=10
LimitNICE=-10
END
write /etc/sysctl.d/60-polysight.conf <<END
# polysight: receive buffers of the capture cards
net.core.rmem_max = 8388608
END
write /etc/udev/rules.d/61-polysight-radar.rules <<END
SUBSYSTEM=="usb", ATTR{idVendor}=="0451", ATTR{idProduct}=="fd03", MODE="0660", GROUP="plugdev"
END
if [ -z "$root" ]; then
    systemctl daemon-reload
    sysctl --quiet --system
    udevadm control --reload
    adduser --quiet "$user" plugdev
fi
echo "$user may run receivers at real-time priority after the next login (from a desktop: after a restart)"
