//! The script that the guest runs once the host's folders are mounted.

use super::table::{GuestTest, ports};

/// Time limit for a test; a test that takes longer counts as hung.
pub const TEST_LIMIT_S: u32 = 300;

/// Links the ports to their names; one after another, they come a while after the module.
const PREFACE: &str = "\
modprobe virtio_console
mkdir -p /dev/virtio-ports
for name in $ports; do
    tries=0
    until port=$(grep -lx $name /sys/class/virtio-ports/*/name 2>/dev/null); do
        tries=$((tries + 1))
        [ $tries -lt 600 ] || { echo \"there is no port $name\" >/dev/console; break; }
        sleep 0.1
    done
    ln -s /dev/$(basename ${port%/name}) /dev/virtio-ports/$name
done
export RUST_BACKTRACE=1
";

/// Generates the script: loads modules, runs each test, and writes its output and exit code to its folder in the share.
pub fn script(tests: &[&GuestTest]) -> String {
    let mut script = format!("ports='{}'\n{PREFACE}", ports(tests).join(" "));
    for GuestTest { name, modules, environment, .. } in tests {
        let environment: String =
            environment.iter().map(|(name, value)| format!("{name}='{value}' ")).collect();
        script += &format!("\ncd /share/{name}\n");
        for module in *modules {
            script += &format!("modprobe {module} >>log 2>&1\n");
        }
        script += &format!(
            "env {environment}timeout -s KILL {TEST_LIMIT_S} ./test --include-ignored --test-threads=1 >>log 2>&1\n\
             code=$?\ndmesg -c >dmesg\necho $code >exit\n"
        );
    }
    script
}
