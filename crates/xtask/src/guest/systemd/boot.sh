echo "newest session: $(newest), $(points) points"
interrupted() { ! is_complete; }
check "the power was cut off in the middle of the run" interrupted
systemctl start multi-user.target
readable() { as ada raysweep sessions; }
check "after a power failure sessions are readable" readable
resumed() { await is_complete && same_bits; }
check "and the service completes the run by itself, to the same bits" resumed
purge() {
    dpkg -P raysweep || return 1
    for path in /run/raysweep /etc/raysweep /usr/share/doc/raysweep /usr/share/raysweep /lib/systemd/system/raysweepd.socket \
        /usr/lib/systemd/system/raysweepd.socket; do
        [ ! -e $path ] || { echo "$path is left"; return 1; }
    done
    ! systemctl list-units --all | grep raysweepd && [ -d "$(newest)" ] && id raysweep
}
check "purging leaves sessions and their owner, and nothing else" purge
failures=$failed
