# Holds the list of packages against a bare Debian: $1 the root to make, $2 its suite, $3 packages that resemble listed
# ones, $4 the executable of xtask, $5 the list. Prints a line for each entry: its names, what xtask says before,
# installed or already, after; or, at last, that there is no root to hold it against.
root=$1 suite=$2 decoys=$3 xtask=$4 list=$5

mmdebstrap --mode=root --variant=minbase --quiet --skip=cleanup/apt --include="$decoys" \
    --dpkgopt=force-unsafe-io --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --dpkgopt='path-exclude=/usr/share/man/*' "$suite" "$root" || { echo "no root"; exit 1; }
cp "$xtask" "$root/usr/bin/xtask"
install -D "$list" "$root/project/tests/packages.txt"
mount_system "$root"

# Of the machine's environment, only what its network may not be reached without.
within() {
    env --ignore-environment CARGO_MANIFEST_DIR=/project/crates/xtask LC_ALL=C DEBIAN_FRONTEND=noninteractive PATH=/usr/sbin:/usr/bin:/sbin:/bin \
        ${http_proxy+"http_proxy=$http_proxy"} ${HTTP_PROXY+"HTTP_PROXY=$HTTP_PROXY"} \
        ${https_proxy+"https_proxy=$https_proxy"} ${HTTPS_PROXY+"HTTPS_PROXY=$HTTPS_PROXY"} \
        ${no_proxy+"no_proxy=$no_proxy"} ${NO_PROXY+"NO_PROXY=$NO_PROXY"} chroot "$root" "$@"
}
# What xtask says of all packages.
said() { within xtask packages 2>/dev/null || true; }
# What xtask has last said of a package, by the name that this release has for it.
state() {
    printf '%s\n' "$last" | while read -r state name why; do
        [ "$name" != "$1" ] || echo "$state"
    done
}
has_candidate() { within apt-cache policy "$1" | grep -q '^ *Candidate: [0-9]'; }
is_installed() { [ "$(within dpkg-query --show --showformat='${db:Status-Status}' "$1" 2>/dev/null)" = installed ]; }

last=$(said)
for names in $(sed 's/[[:space:]].*//; /^#/d; /^$/d' "$list"); do
    for package in $(echo "$names" | tr '|' ' '); do
        ! has_candidate "$package" || break
    done
    before=$(state "$package")
    how=already
    if ! is_installed "$package"; then
        within apt-get install --yes -qq --no-install-recommends "$package" >"$root/tmp/log" 2>&1 </dev/null || cat "$root/tmp/log"
        how=installed
        last=$(said)
    fi
    echo "entry $names $before $how $(state "$package")"
done
# It succeeds now that all are present.
within xtask packages
