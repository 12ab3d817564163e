# The README's two commands on a bare Debian: $1 the root to make, $2 its suite, $3 the machine's Rust, $4 the repository; what
# follows are environment variables NAME=VALUE that the network needs.
root=$1 suite=$2 rust=$3 checkout=$4
shift 4

mmdebstrap --mode=root --variant=minbase --quiet --include=ca-certificates,git,gcc,libc6-dev \
    --dpkgopt=force-unsafe-io "$suite" "$root"
# Where the machine trusts more than Debian does, what the root downloads does too.
! [ -e /etc/ssl/certs/ca-certificates.crt ] || cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"

mount_system "$root"
# Lets the root read a folder of the machine.
lend() {
    mkdir "$root$2"
    mount --bind "$1" "$root$2"
    mount -o remount,bind,ro "$root$2"
}
lend "$rust" /opt/rust
lend "$checkout" /opt/checkout

script='
umount --lazy /mnt
git config --global --add safe.directory "*"
git clone --quiet /opt/checkout /root/raysweep
cd /root/raysweep
git log -1 --format="checkout: %h %s"
for command in demo test; do
    began=$(date +%s)
    code=0
    cargo xtask $command </dev/null || code=$?
    echo "fresh: cargo xtask $command: code $code, $(($(date +%s) - began)) s"
    [ $code = 0 ] || exit $code
done'
# The root becomes that of all mounts: where chroot alone has changed it, the kernel refuses user namespaces.
cd "$root"
pivot_root . mnt
exec env --ignore-environment "$@" HOME=/root LANG=C.UTF-8 \
    PATH=/opt/rust/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin chroot . sh -euc "$script"
