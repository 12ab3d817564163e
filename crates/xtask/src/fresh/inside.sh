# The README's two commands on a bare Debian: $1 the root to make, $2 its suite, $3 the machine's Rust, $4 the checkout; what
# follows are environment variables NAME=VALUE that the network needs.
root=$1 suite=$2 rust=$3 checkout=$4
shift 4

mmdebstrap --mode=root --variant=minbase --quiet --include=ca-certificates,git,gcc,libc6-dev \
    --dpkgopt=force-unsafe-io "$suite" "$root"
# Where the machine trusts more than Debian does, what the root downloads does too.
! [ -e /etc/ssl/certs/ca-certificates.crt ] || cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"

# A program that has mounts of its own needs a root that is one.
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount -t sysfs -o ro sysfs "$root/sys" || mount --rbind /sys "$root/sys"
mount -t tmpfs -o mode=755 tmpfs "$root/dev"
for device in null zero full random urandom tty; do
    touch "$root/dev/$device"
    mount --bind "/dev/$device" "$root/dev/$device"
done
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$root/dev/pts"
mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"
ln -s fd/0 "$root/dev/stdin"
ln -s fd/1 "$root/dev/stdout"
ln -s fd/2 "$root/dev/stderr"

lend() {
    mkdir "$root$2"
    mount --bind "$1" "$root$2"
    mount -o remount,bind,ro "$root$2"
}
lend "$rust" /opt/rust
lend "$checkout" /opt/checkout

within() {
    env --ignore-environment "$@" HOME=/root LANG=C.UTF-8 PATH=/opt/rust/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        chroot "$root" sh -euc "$script"
}
script='
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
within "$@"
