//! Two hosts connected by a cable. Each host is a network namespace, held open by a sleeping process.

use std::fs;
use std::path::Path;
use std::process::Command;

use super::must;
use crate::common::Running;
use crate::common::processes::wait_until;

/// The address of the first host.
pub const HEAD: &str = "10.77.0.1";
/// The address of the second host.
pub const NODE: &str = "10.77.0.2";

/// Two hosts and the cable between them, removed on drop.
pub struct Cable {
    head: Running,
    node: Running,
}

impl Cable {
    pub fn new() -> Self {
        let [head, node] = [namespace(), namespace()];
        let (here, there) = (head.0.id(), node.0.id());
        // Create the cable inside the namespaces, so that its names cannot collide with others.
        must(&format!(
            "nsenter --net=/proc/{here}/ns/net ip link add cable type veth peer name cable netns {there}"
        ));
        let cable = Self { head, node };
        for (host, address) in [(&cable.head, HEAD), (&cable.node, NODE)] {
            inside(host, &format!("ip address add {address}/24 dev cable"));
            inside(host, "ip link set lo up");
            inside(host, "ip link set cable up");
        }
        cable
    }

    /// The command prefixes that start programs on the first and on the second host.
    pub fn through(&self) -> [Vec<String>; 2] {
        [&self.head, &self.node].map(|host| vec!["nsenter".to_owned(), net(host)])
    }

    pub fn cut(&self) {
        inside(&self.node, "ip link set cable down");
    }

    pub fn mend(&self) {
        inside(&self.node, "ip link set cable up");
    }

    /// Drops packets that the second host receives and sends, if the nftables condition matches; `None` drops none.
    pub fn drop_where(&self, comes_in: Option<&str>, leaves: Option<&str>) {
        inside(&self.node, "nft flush ruleset");
        inside(&self.node, "nft add table ip faults");
        for (hook, condition) in [("input", comes_in), ("output", leaves)] {
            let Some(condition) = condition else { continue };
            let chain = format!("{{ type filter hook {hook} priority 0; }}");
            inside(&self.node, &format!("nft 'add chain ip faults {hook} {chain}'"));
            inside(&self.node, &format!("nft 'add rule ip faults {hook} {condition} drop'"));
        }
    }
}

fn namespace() -> Running {
    let sleeping = Command::new("unshare").args(["--net", "sleep", "3600"]).spawn();
    let holder = Running(sleeping.expect("unshare, of util-linux"));
    let own = fs::read_link("/proc/self/ns/net").expect("/proc");
    let path = format!("/proc/{}/ns/net", holder.0.id());
    wait_until("there is a namespace (as root)", || {
        fs::read_link(Path::new(&path)).is_ok_and(|other| other != own)
    });
    holder
}

fn net(host: &Running) -> String {
    format!("--net=/proc/{}/ns/net", host.0.id())
}

fn inside(host: &Running, command: &str) {
    must(&format!("nsenter {} {command}", net(host)));
}
