//! Permissions: derives roles from the peer credentials that the kernel provides (`SO_PEERCRED`, unix(7)).

use std::ffi::CString;
use std::io;

use nix::unistd::{Gid, Group, Uid, User, geteuid, getgrouplist};
use raysweep_proto::{ErrorCode, Method, Role, RpcError};
use tokio::net::UnixStream;

/// The user behind a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    /// Effective user at the time of connecting.
    pub uid: u32,
    /// Effective group at the time of connecting.
    pub gid: u32,
}

/// Distinguishes operators from observers. Operators are root, the daemon's own user and the members of one group;
/// everybody else who can open the socket is an observer.
#[derive(Debug, Clone)]
pub struct Access {
    operators: Option<String>,
    owner: Uid,
    identify: fn(&UnixStream) -> io::Result<Peer>,
}

impl Access {
    /// Access with the operators' group, if there is one.
    pub fn new(operators: Option<String>) -> Self {
        Self::identified_by(operators, |stream| {
            let credentials = stream.peer_cred()?;
            Ok(Peer { uid: credentials.uid(), gid: credentials.gid() })
        })
    }

    /// Like [`Access::new`], with another way to identify the peer.
    pub fn identified_by(operators: Option<String>, identify: fn(&UnixStream) -> io::Result<Peer>) -> Self {
        Self { operators, owner: geteuid(), identify }
    }

    /// The user at the far end of a connection.
    ///
    /// # Errors
    /// When the kernel does not provide the credentials.
    pub(super) fn peer(&self, stream: &UnixStream) -> io::Result<Peer> {
        (self.identify)(stream)
    }

    /// The role of a user. Queries the user database, which may block.
    pub fn role(&self, peer: Peer) -> Role {
        let uid = Uid::from_raw(peer.uid);
        if uid.is_root() || uid == self.owner {
            return Role::Operator;
        }
        let Some(operators) = &self.operators else { return Role::Observer };
        match is_member(peer, operators) {
            Ok(true) => Role::Operator,
            Ok(false) => Role::Observer,
            Err(error) => {
                tracing::warn!(%error, uid = peer.uid, group = operators, "cannot look a user up: an observer");
                Role::Observer
            }
        }
    }

    /// The group whose members are operators, if one is set.
    pub(super) fn operators(&self) -> Option<String> {
        self.operators.clone()
    }

    /// The error for an observer who calls a method reserved for operators.
    pub(super) fn forbidden(&self, method: Method, peer: Peer) -> RpcError {
        let name = method.name();
        let message =
            format!("`{name}` is reserved for operators, and the user with id {} is an observer", peer.uid);
        let help = match &self.operators {
            Some(group) if group != "root" => format!("join the group `{group}` (`usermod -aG {group} USER` as root)"),
            _ => "call it as root or as the daemon's own user; `raysweepd --operators GROUP` names a group of operators".into(),
        };
        RpcError::new(ErrorCode::Forbidden, format!("{message}: {help}")).with_help(help)
    }
}

/// Whether a group is a user's primary or one of its supplementary groups. A group that does not exist has no members.
fn is_member(peer: Peer, group: &str) -> nix::Result<bool> {
    let Some(group) = Group::from_name(group)? else { return Ok(false) };
    if group.gid == Gid::from_raw(peer.gid) {
        return Ok(true);
    }
    let Some(user) = User::from_uid(Uid::from_raw(peer.uid))? else { return Ok(false) };
    // A name from the user database contains no NUL.
    let Ok(name) = CString::new(user.name) else { return Ok(false) };
    Ok(getgrouplist(&name, user.gid)?.contains(&group.gid))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The user `nobody` on every system; its groups are not used here.
    const STRANGER: Peer = Peer { uid: 65534, gid: 65534 };

    fn access(group: Option<&str>) -> Access {
        Access::new(group.map(str::to_owned))
    }

    #[test]
    fn root_and_the_daemons_own_user_drive() {
        for group in [None, Some("root"), Some("no-such-group")] {
            let access = Access { owner: Uid::from_raw(61234), ..access(group) };
            assert_eq!(access.role(Peer { uid: 0, ..STRANGER }), Role::Operator);
            assert_eq!(access.role(Peer { uid: 61234, ..STRANGER }), Role::Operator);
            assert_eq!(access.role(STRANGER), Role::Observer);
        }
        assert_eq!(access(None).owner, geteuid());
    }

    #[test]
    fn a_member_drives_by_primary_group_and_by_the_groups_list() {
        assert_eq!(access(Some("root")).role(Peer { gid: 0, ..STRANGER }), Role::Operator, "primary group");
        assert_eq!(access(None).role(Peer { gid: 0, ..STRANGER }), Role::Observer, "no group is set");
        // Members that /etc/group lists beyond their primary group, if this machine has any.
        let text = std::fs::read_to_string("/etc/group").unwrap();
        let members = text.lines().filter_map(|line| {
            let fields: Vec<_> = line.split(':').collect();
            let user = fields.get(3)?.split(',').next().filter(|name| !name.is_empty())?;
            Some((fields[0].to_owned(), User::from_name(user).ok()??))
        });
        for (group, user) in members {
            let peer = Peer { uid: user.uid.as_raw(), gid: 65534 };
            assert_eq!(access(Some(&group)).role(peer), Role::Operator, "{} in {group}", user.name);
        }
    }

    #[test]
    fn who_is_forbidden_learns_which_group_to_join() {
        let error = access(Some("raysweep")).forbidden(Method::Run, STRANGER);
        assert_eq!(error.name(), Some(ErrorCode::Forbidden));
        assert!(error.data.is_some_and(|data| data.help.is_some_and(|help| help.contains("raysweep"))));
        let error = access(Some("root")).forbidden(Method::Run, STRANGER);
        assert!(!error.message.contains("usermod") && error.message.contains("--operators GROUP"), "{error}");
    }
}
