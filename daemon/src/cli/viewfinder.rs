//! `raysweep viewfinder`: starts a viewfinder, or changes the one that runs.

use std::path::{Path, PathBuf};

use raysweep_proto::{Client, ClientError, ErrorCode, RpcError, ViewfinderParams};

use super::arguments::ViewfinderArguments;
use super::exit::Exit;
use super::failure::CommandFailure;
use super::plan_file::read_plan;
use super::printer::Printer;

impl ViewfinderArguments {
    /// A plan with what is given.
    fn plan(&self) -> String {
        let mut plan = "kind = \"viewfinder\"\n[viewfinder]\n".to_owned();
        let picture = self.picture.map(|picture| format!("picture = \"{}\"\n", picture.name()));
        let trigger = self.trigger.map(|trigger| format!("trigger = \"{}\"\n", trigger.name()));
        let region = self.region.map(|region| format!("region = {region:?}\n"));
        let exposure = self.exposure_us.map(|exposure_us| format!("exposure_us = {exposure_us:?}\n"));
        let subject = self.board.then(|| "subject = \"board\"\n".to_owned());
        let seconds = self.seconds.map(|seconds| format!("seconds = {seconds:?}\n"));
        plan.extend([picture, trigger, region, exposure, subject, seconds].into_iter().flatten());
        plan
    }
}

/// What remains to be done: a viewfinder to be started with this plan, or nothing, because one runs.
pub(super) enum Wanted {
    /// The path that messages name, and the text.
    Plan(PathBuf, String),
    Nothing {
        is_changed: bool,
    },
}

/// Changes the viewfinder that runs; otherwise returns the plan of one to start.
pub(super) fn change_or_plan(
    socket: &Path,
    arguments: &ViewfinderArguments,
) -> Result<Wanted, CommandFailure> {
    let mut client = Client::connect(socket)?;
    let status = client.status()?;
    if let (false, None) = (status.state.is_over(), &arguments.plan) {
        let ViewfinderArguments { picture, trigger, region, exposure_us, board, seconds, .. } = *arguments;
        let is_of_another = board || seconds.is_some() || trigger.is_some();
        if is_of_another && status.viewfinder.is_some() {
            let message = "a viewfinder runs, and --board, --seconds and --trigger are for one that begins: end it with `raysweep cancel` first";
            return Err(ClientError::Rpc(RpcError::new(ErrorCode::Busy, message)).into());
        }
        // One that has not shown anything yet is not in the status.
        let wanted = ViewfinderParams { picture, region, exposure_us, delay_us: None };
        match (!is_of_another).then(|| client.viewfinder(&wanted)) {
            None => {}
            Some(Ok(())) => {
                return Ok(Wanted::Nothing { is_changed: wanted != ViewfinderParams::default() });
            }
            Some(Err(ClientError::Rpc(error))) if error.name() == Some(ErrorCode::NotRunning) => {}
            Some(Err(error)) => return Err(error.into()),
        }
    }
    match &arguments.plan {
        Some(path) => Ok(Wanted::Plan(path.clone(), read_plan(path)?)),
        None => Ok(Wanted::Plan("viewfinder".into(), arguments.plan())),
    }
}

/// Says that one runs, and whether it was changed.
pub(super) fn runs(is_changed: bool, printer: Printer) -> Result<Exit, CommandFailure> {
    printer.print(&raysweep_proto::Empty {}, |_| match is_changed {
        true => "the running viewfinder was changed".into(),
        false => "a viewfinder runs already: --picture, --region and --exposure-us change it, `raysweep cancel` ends it".into(),
    })?;
    Ok(Exit::Done)
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use raysweep_config::plan::FinderTrigger;
    use raysweep_config::{Plan, Procedure};
    use raysweep_core::FinderPicture;

    use super::super::arguments::{Arguments, Command};

    #[test]
    fn arguments_become_a_plan() {
        let line = "raysweep viewfinder --picture grid --trigger none --region 1,2,3,4 --exposure-us 5 --board --seconds 2.5";
        let Command::Viewfinder(arguments) = Arguments::parse_from(line.split(' ')).command else {
            panic!("another command")
        };
        let plan = Plan::parse(&arguments.plan()).unwrap();
        let Procedure::Viewfinder(own) = plan.procedure else { panic!("{plan:?}") };
        assert_eq!((own.picture, own.region), (FinderPicture::Grid, Some([1, 2, 3, 4])));
        assert_eq!((own.exposure_us, own.seconds), (Some(5.0), Some(2.5)));
        assert_eq!((own.trigger, own.subject.is_some()), (FinderTrigger::None, true));
    }

    #[test]
    fn a_region_has_four_numbers() {
        for region in ["1,2,3", "1,2,3,-4", "1,2,3,4,5", "all"] {
            assert!(Arguments::try_parse_from(["raysweep", "viewfinder", "--region", region]).is_err());
        }
    }
}
