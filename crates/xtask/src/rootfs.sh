# Output is one stream. What guards that were killed have left goes first: roots are named after their processes.
exec 2>&1
for left in "${1%.*}".*; do
    [ -e "/proc/${left##*.}" ] || rm --recursive --force --one-file-system "$left"
done
rm --recursive --force --one-file-system "$1"

# Mounts in the root $1 what containers have: itself, without which programs in it could have no mounts of their own,
# processes, the machine's devices to read, and those devices that hold nothing.
mount_system() {
    mount --bind "$1" "$1"
    mount -t proc proc "$1/proc"
    # A user may not mount this anew, only what is there already.
    mount -t sysfs -o ro sysfs "$1/sys" 2>/dev/null || mount --rbind /sys "$1/sys"
    mount -t tmpfs -o mode=755 tmpfs "$1/dev"
    for device in null zero full random urandom tty; do
        touch "$1/dev/$device"
        mount --bind "/dev/$device" "$1/dev/$device"
    done
    mkdir "$1/dev/pts" "$1/dev/shm"
    mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$1/dev/pts"
    mount -t tmpfs -o mode=1777 tmpfs "$1/dev/shm"
    ln -s pts/ptmx "$1/dev/ptmx"
    ln -s /proc/self/fd "$1/dev/fd"
    for stream in 0/stdin 1/stdout 2/stderr; do
        ln -s "fd/${stream%/*}" "$1/dev/${stream#*/}"
    done
}

