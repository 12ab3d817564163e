#!/bin/sh
# What the scripts in the guest share. Each prints a line for each check, as cargo's tests do, and what it does before.
exec >>"/share/$STAGE/log" 2>&1
trap 'echo "$failures" >"/share/$STAGE/exit"; sync' EXIT
failures=1
failed=0
DATA=/var/lib/raysweep
cd /share

# check NAME COMMAND...: passes if the command succeeds.
check() {
    name=$1
    shift
    began=$(cut -d' ' -f1 /proc/uptime)
    if "$@"; then verdict=ok; else verdict=FAILED failed=1; fi
    echo "test $name ... $verdict ($began to $(cut -d' ' -f1 /proc/uptime) s)"
    [ "$verdict" = ok ] || journalctl --no-pager -o short-monotonic -n 40
}
# Waits until the command succeeds: for at least five minutes, as machines are busy.
await() {
    for attempt in $(seq 600); do
        ! "$@" || return 0
        sleep 0.5 # To look takes as long in software emulation.
    done
    echo "not within minutes: $*"
    return 1
}
# code EXPECTED COMMAND...: whether the command ends with this code.
code() {
    expected=$1
    shift
    "$@" && got=0 || got=$?
    [ "$got" = "$expected" ] || { echo "code $got instead of $expected: $*"; return 1; }
}
property() { systemctl show -P "$1" raysweepd.service; }
is_active() { [ "$(property ActiveState)" = active ]; }
as() { user=$1; shift; runuser -u "$user" -- "$@"; }
newest() { ls -d "$DATA"/2*_* 2>/dev/null | tail -n 1; }
points() { grep -c '"event":"point"' "$(newest)/ledger.jsonl"; }
# Whether the run is in the middle of its points.
is_midway() { [ -e "$(newest)/ledger.jsonl" ] && [ "$(points)" -ge 6 ]; }
is_complete() { tail -n 1 "$(newest)/ledger.jsonl" | grep -q '"complete"' && [ -s "$(newest)/manifest.json" ]; }
bits() { sha256sum <"$(newest)/products/transport.npy"; }
# Whether the newest session has the bits of the undisturbed one.
same_bits() { [ "$(bits)" = "$(cat /share/bits)" ] || { echo "other bits"; return 1; }; }
# Starts a run as the operator, and waits until it is in its middle; its client is $client.
begin() {
    before=$(newest)
    sleep 1 # Names of sessions have seconds.
    runuser -u ada -- raysweep run /share/plan.toml </dev/null &
    client=$!
    is_new() { [ "$(newest)" != "$before" ] && is_midway; }
    await is_new
}
