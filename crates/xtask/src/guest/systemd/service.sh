# The unit loads the drivers' modules.
depmod
systemctl start multi-user.target

installs() {
    dpkg -i /share/raysweep.deb && await is_active && systemctl --quiet is-enabled raysweepd.socket raysweepd.service
}
check "the package installs, and its simulated rig serves" installs
examples() {
    folder=/usr/share/doc/raysweep/examples
    ! grep -r "tests/data" $folder /etc/raysweep || return 1
    for rig in $folder/rigs/*.toml; do
        scene=$(sed -n 's/^scene = "\(.*\.np[yz]\)".*/\1/p' "$rig")
        [ -z "$scene" ] || [ -e "$folder/rigs/$scene" ] || { echo "$rig: no $scene"; return 1; }
    done
    [ -e $folder/scenes/p2r_corner.npz ] && [ -e $folder/plans/quick.toml ]
}
check "examples name only what is installed" examples
# A smaller scene, as each start builds it.
cp /share/rig.toml /etc/raysweep/rig.toml
useradd -m -G raysweep ada
useradd -m eve
operator_at_once() { systemctl stop raysweepd.service && code 0 as ada raysweep status && await is_active; }
check "a member of the group uses it at once: the socket starts the daemon" operator_at_once
observer() { code 0 as eve raysweep status && code 5 as eve raysweep run /share/plan.toml && code 5 as eve raysweep cancel; }
check "any other user may look, and is refused orders" observer
buffers() { [ "$(cat /proc/sys/net/core/rmem_max)" -ge 16777216 ]; }
check "rmem_max acts without a reboot" buffers
pages() { zgrep -q "raysweep" /usr/share/man/man1/raysweep-run.1.gz /usr/share/man/man8/raysweepd.8.gz; }
check "manual pages are there" pages

mkdir -p /etc/systemd/system/raysweepd.service.d
# Reloading runs this within the unit's sandbox: the devices are opened by the service that runs, as its user.
printf '[Service]\nExecReload=/bin/sh /share/open.sh\n' >/etc/systemd/system/raysweepd.service.d/open.conf
systemctl daemon-reload
systemctl restart raysweepd.service

sweep() { code 0 as ada raysweep run /share/plan.toml </dev/null && is_complete && bits >/share/bits; }
check "an operator's sweep over the socket completes" sweep
live() { code 0 as eve raysweep preview --output /home/eve/live.png && ! as eve ls $DATA; }
check "any other user sees the live images, and no session" live

devices() {
    # Plugged in after the daemon was started.
    modprobe dummy_hcd && modprobe g_serial idVendor=0x0925 idProduct=0x3881
    modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3
    modprobe xhci_pci && modprobe ftdi_sio && modprobe virtio-gpu
    ldattach pps /dev/ttyS1
    analyser() { grep -l 0925 /sys/bus/usb/devices/*/idVendor; }
    await test -c /dev/ttyUSB0 && await test -c /dev/ttyACM0 && await test -c /dev/video0 && await test -c /dev/pps0 &&
        await analyser || return 1
    udevadm settle
    device=$(dirname "$(analyser)")
    printf '/dev/bus/usb/%03d/%03d\n' "$(cat "$device/busnum")" "$(cat "$device/devnum")" >/share/analyser
    systemctl reload raysweepd.service
}
check "the service opens a device of each class, plugged in after its start, and obtains SCHED_FIFO" devices

mirror() {
    modprobe virtio_console
    for port in /sys/class/virtio-ports/*; do
        [ "$(cat "$port/name")" != serial ] || peer=/dev/${port##*/}
    done
    sh /share/optotune.sh "$peer" /share/mirror.log &
    controller=$!
    # What the daemon writes before a mirror leaves its origin.
    sed "s/BOOT/$(cat /proc/sys/kernel/random/boot_id)/" /share/mirror.json >$DATA/mirror.json
    chown raysweep:raysweep $DATA/mirror.json
    systemctl kill --kill-who=main --signal=KILL raysweepd.service
    await grep -q "XY=0" /share/mirror.log
    parked=$?
    await is_active
    kill $controller
    cat /share/mirror.log
    rm -f $DATA/mirror.json*
    return $parked
}
check "ExecStopPost parks a mirror after SIGKILL" mirror

score() { systemd-analyze security --no-pager raysweepd.service | sed -n 's/.*Overall exposure level.*: \([0-9.]*\) .*/\1/p'; }
at_most() { echo "exposure $1, at most $2"; [ -n "$1" ] && [ "$(printf '%s\n' "$1" "$2" | sort -n | tail -n 1)" = "$2" ]; }
check "exposure of the unit" at_most "$(score)" 2.0
unusable() {
    systemctl reset-failed raysweepd.service
    echo 'kind = "cube"' >/etc/raysweep/rig.toml
    ! systemctl restart raysweepd.service || return 1
    restarts=$(property NRestarts)
    code 4 timeout 300 runuser -u ada -- raysweep status || return 1
    [ "$(property NRestarts)" = "$restarts" ] && journalctl -u raysweepd.service -p err -o cat | grep "rig.toml"
}
check "an unusable rig file: an error in the journal, no restart, and clients are told" unusable
missing() {
    rm /etc/raysweep/rig.toml
    systemctl reset-failed raysweepd.service raysweepd.socket
    systemctl restart raysweepd.socket
    code 4 timeout 300 runuser -u ada -- raysweep status && [ "$(property ActiveState)" = failed ] &&
        journalctl -u raysweepd.service -p err -o cat | grep "rig.toml.*No such file"
}
check "no rig file: the same" missing
repaired() {
    cp /share/rig.toml /etc/raysweep/rig.toml
    systemctl reset-failed raysweepd.service raysweepd.socket
    systemctl restart raysweepd.socket && code 0 as ada raysweep status
}
check "with a rig file it serves again" repaired
simulated() {
    install -D -m 644 /usr/share/raysweep/simulated.conf /etc/systemd/system/raysweepd.service.d/simulated.conf
    systemctl daemon-reload && systemctl restart raysweepd.service && at_most "$(score)" 0.5 &&
        observer && begin && code 0 wait $client && is_complete && same_bits
}
check "with simulated.conf: exposure, operator and observer" simulated
rm /etc/systemd/system/raysweepd.service.d/*.conf
systemctl daemon-reload

crash() {
    systemctl reset-failed raysweepd.service
    begin && pid=$(property MainPID) && kill -9 "$pid" && code 4 wait $client && await is_active &&
        [ "$(property MainPID)" != "$pid" ] && await is_complete && same_bits
}
check "after SIGKILL it is started again and completes the run, to the same bits" crash

stopped() {
    begin && systemctl stop raysweepd.service && code 3 wait $client && [ -S /run/raysweep/raysweepd.sock ] &&
        code 0 as ada raysweep resume "$(newest)" </dev/null && is_complete && same_bits
}
check "a stop ends the run in order, and resume completes it to the same bits" stopped

hangs() {
    pid=$(property MainPID)
    sleep 12
    [ "$(property MainPID)" = "$pid" ] || { echo "ended although it does not hang"; return 1; }
    begin && kill -STOP "$pid" && code 4 wait $client && await is_active && await is_complete && same_bits &&
        journalctl -u raysweepd.service | grep -q "result 'watchdog'"
}
watchdog() {
    printf '[Service]\nWatchdogSec=10\n' >/etc/systemd/system/raysweepd.service.d/watchdog.conf
    systemctl daemon-reload && systemctl restart raysweepd.service && hangs
    found=$?
    rm /etc/systemd/system/raysweepd.service.d/watchdog.conf
    systemctl daemon-reload && systemctl restart raysweepd.service && return $found
}
check "the watchdog ends a daemon that hangs (SIGSTOP), and the run completes" watchdog

upgrade() {
    # Paused, the run is in progress as long as the installation takes.
    begin && as ada raysweep pause && pid=$(property MainPID) && dpkg -i /share/raysweep.deb &&
        [ "$(property MainPID)" = "$pid" ] && as ada raysweep continue && code 0 wait $client && is_complete &&
        same_bits || return 1
    has_retired() { [ "$(property MainPID)" != "$pid" ]; }
    await has_retired && cmp /share/rig.toml /etc/raysweep/rig.toml && code 0 as ada raysweep status && await is_active
}
check "an upgrade lets the run end, keeps rig file and sessions, and then takes effect" upgrade

log() {
    journalctl -u raysweepd.service -o cat >/share/service/journal
    ! grep -E '^(<[0-9]>|20[0-9][0-9]-)' /share/service/journal && ! grep -i "mirror is parked" /share/service/journal
}
check "log lines have no second time stamp" log
failures=$failed
