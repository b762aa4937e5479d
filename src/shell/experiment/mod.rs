//! `apexd experiment`.

mod machine;
mod page;
mod store;
mod work;

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};

use page::Page;
use serde_json::{Map, Value, json};
use store::{Session, Store, StoreError};

use super::cli::experiment::{
    BarnArgs, CampaignArgs, ExperimentArgs, MergeArgs, PaperArgs, ShowArgs, Which, WorkArgs,
};
use super::progress::Terminal;
use super::report::experiment as figures;
use super::{Exit, complain, folder, say};
use crate::experiment::barn::{Field, find_fields};
use crate::experiment::campaign::CampaignError;
use crate::experiment::dataset::{find_maps, map_hash};
use crate::experiment::paper::{Analysis, Optima};
use crate::experiment::results::Results;
use crate::experiment::run::{Record, RunError, SpecError, Task};
use crate::experiment::table::Table;
use crate::experiment::{barn, campaign, paper};
use crate::mapfile;

/// Drives an experiment, or joins results.
pub fn run(args: &ExperimentArgs, terminal: &Terminal, out: &mut dyn Write) -> Exit {
    let done = match &args.which {
        Which::Paper(args) => run_paper(args, terminal, out),
        Which::Campaign(args) => run_campaign(args, terminal, out),
        Which::Barn(args) => run_barn(args, terminal, out),
        Which::Merge(args) => merge(args, out),
    };
    done.unwrap_or_else(|(exit, text)| {
        complain(&text);
        exit
    })
}

/// How a command ends early, and what it says.
type Trouble = (Exit, String);

fn usage(error: impl std::fmt::Display) -> Trouble {
    (Exit::Usage, error.to_string())
}

/// Parameters that are refused are a matter of configuration, all else of usage.
fn refused(error: &SpecError) -> Trouble {
    let configuration = matches!(error, SpecError::Parameters(_));
    (if configuration { Exit::Configuration } else { Exit::Usage }, error.to_string())
}

fn failed(error: impl std::fmt::Display) -> Trouble {
    (Exit::Failed, error.to_string())
}

fn run_paper(args: &PaperArgs, terminal: &Terminal, out: &mut dyn Write) -> Result<Exit, Trouble> {
    let optima = optima(&args.work.show)?;
    let tasks = args.request().tasks().map_err(|error| refused(&error))?;
    drive(paper::NAME, &args.work, &tasks, &optima, terminal, out)
}

fn run_campaign(
    args: &CampaignArgs,
    terminal: &Terminal,
    out: &mut dyn Write,
) -> Result<Exit, Trouble> {
    let found = find_maps(&args.maps).map_err(usage)?;
    let maps = found.iter().map(|(file, _)| file.to_string_lossy().into_owned()).collect();
    let tasks = args.request(maps).tasks().map_err(|error| match error {
        CampaignError::Run(RunError::Spec(error)) => refused(&error),
        error => usage(error),
    })?;
    drive(campaign::NAME, &args.work, &tasks, &Optima::default(), terminal, out)
}

fn run_barn(args: &BarnArgs, terminal: &Terminal, out: &mut dyn Write) -> Result<Exit, Trouble> {
    let fields = find_fields(&args.worlds).map_err(usage)?;
    let place = results_folder(barn::NAME, &args.work)?;
    let maps = folder::prepare(Some(&place.join("worlds"))).map_err(usage)?;
    let written = fields
        .into_iter()
        .map(|field| {
            let file = write_map(&field, args.resolution, &maps)?;
            Ok((field, file.to_string_lossy().into_owned()))
        })
        .collect::<Result<_, Trouble>>()?;
    let tasks = args.request(written).tasks().map_err(|error| refused(&error))?;
    drive(barn::NAME, &args.work, &tasks, &Optima::default(), terminal, out)
}

/// Writes a world to a map file of its own, so that each drive can be repeated by a command. The
/// name follows from what the map says: other maps are other drives.
fn write_map(field: &Field, resolution_m: f64, folder: &Path) -> Result<PathBuf, Trouble> {
    let map = field.world(resolution_m).to_map_file();
    let name = format!("world_{:03}-{}", field.number, &map_hash(&map)[..8]);
    let file = folder.join(format!("{name}.yaml"));
    if mapfile::load(&file).is_ok_and(|there| there == map) {
        return Ok(file);
    }
    // Another shard may be reading or writing it: never half a file where a whole one was.
    let drafts = folder.join(format!("draft-{}", std::process::id()));
    std::fs::create_dir_all(&drafts).map_err(failed)?;
    mapfile::save(drafts.join(format!("{name}.yaml")), &map).map_err(failed)?;
    for end in ["pgm", "yaml"] {
        let from = drafts.join(format!("{name}.{end}"));
        std::fs::rename(&from, folder.join(format!("{name}.{end}"))).map_err(failed)?;
    }
    folder::discard_if_empty(&drafts);
    Ok(file)
}

/// The folder for the results of an experiment.
fn results_folder(name: &str, args: &WorkArgs) -> Result<PathBuf, Trouble> {
    let own = Path::new("runs").join(name);
    folder::prepare(Some(args.out.as_deref().unwrap_or(&own))).map_err(usage)
}

fn optima(show: &ShowArgs) -> Result<Optima, Trouble> {
    let Some(path) = &show.optimum else { return Ok(Optima::default()) };
    let text = std::fs::read_to_string(path)
        .map_err(|error| usage(format!("{}: {error}", path.display())))?;
    Optima::parse(&text).map_err(|error| usage(format!("{}: {error}", path.display())))
}

/// Drives what is left of an experiment and shows what there is.
fn drive(
    name: &'static str,
    args: &WorkArgs,
    tasks: &[Task],
    optima: &Optima,
    terminal: &Terminal,
    out: &mut dyn Write,
) -> Result<Exit, Trouble> {
    let program = machine::program();
    let jobs = args.jobs.map_or_else(machine::cores, usize::from);
    let place = results_folder(name, args)?;
    let pictures = folder::prepare(Some(&place.join("figures"))).map_err(usage)?;
    let tasks: Vec<Task> = match args.shard {
        // In the order of their keys, so that long and short drives are spread evenly.
        Some([i, n]) => {
            (0..).zip(tasks).filter(|(k, _)| k % n == i).map(|(_, t)| t.clone()).collect()
        }
        None => tasks.to_vec(),
    };
    let keys: BTreeSet<String> = tasks.iter().map(Task::key).collect();
    let store = Store::open(&place, args.shard).map_err(failed)?;
    let mut results = Results::default();
    let fits = |record: &Record| args.any_build || record.program == program;
    store::read_results(&mut results, &place, &fits).map_err(failed)?;
    let session = Session {
        command: machine::command(),
        program: program.clone(),
        machine: machine::description(),
        began: folder::now(),
        jobs,
    };
    store::note_session(&place, args.shard, &session).map_err(failed)?;

    let bar = terminal.count_bar("drives");
    let show = |done, total| bar.show(done, total);
    let done = work::drive(&tasks, &mut results, &store, &pictures, jobs, &program, &show);
    bar.finish();
    let done = done.map_err(failed)?;

    let count = keys.iter().filter(|key| results.contains(key)).count();
    let unsafe_drives = results
        .iter()
        .filter(|record| record.drive.collisions + record.drive.unknown_entries > 0)
        .count();
    let shown = if args.shard.is_some() {
        // Tables of a part would be taken for those of the whole.
        let text = format!(
            "{count} drives of this part are done; join the parts with `apexd experiment merge`"
        );
        if args.show.json {
            say(out, &json!({ "experiment": name, "drives": count }).to_string());
        } else {
            say(out, &text);
        }
        Ok(())
    } else {
        show_results(name, &place, &args.show, &results, optima, tasks.len(), out)
    };
    for command in &done.crashed {
        complain(&format!("the program did not survive {command}"));
    }
    if done.interrupted {
        let total = tasks.len();
        complain(&format!(
            "interrupted: {count} of {total} drives are done; the same command goes on"
        ));
    }
    shown?;
    let well = done.crashed.is_empty() && !done.interrupted && unsafe_drives == 0;
    Ok(if well { Exit::Done } else { Exit::Failed })
}

fn merge(args: &MergeArgs, out: &mut dyn Write) -> Result<Exit, Trouble> {
    let optima = optima(&args.show)?;
    let mut results = Results::default();
    let mut sessions = Vec::new();
    for folder in &args.folders {
        store::read_results(&mut results, folder, &|_| true).map_err(usage)?;
        sessions.extend(store::read_sessions(folder).map_err(usage)?);
    }
    let programs: BTreeSet<&str> = results.iter().map(|r| &*r.program).collect();
    if programs.len() > 1 && !args.any_build {
        let programs: Vec<&str> = programs.into_iter().collect();
        return Err(usage(format!(
            "the results are of different builds ({}); --any-build joins them all the same",
            programs.join(", ")
        )));
    }
    let place =
        folder::prepare(Some(args.out.as_ref().unwrap_or(&args.folders[0]))).map_err(usage)?;
    join(&place, args, &results, &sessions).map_err(failed)?;
    let names: BTreeSet<&str> = results.iter().map(|r| &*r.task.experiment).collect();
    if results.is_empty() {
        return Err(usage("there are no results to join"));
    }
    let all = [paper::NAME, campaign::NAME, barn::NAME];
    for name in all.into_iter().filter(|name| names.contains(name)) {
        let total = results.iter().filter(|r| r.task.experiment == name).count();
        show_results(name, &place, &args.show, &results, &optima, total, out)?;
    }
    Ok(Exit::Done)
}

/// Writes all results to one file, in the order of their keys, and brings the pictures together.
fn join(
    place: &Path,
    args: &MergeArgs,
    results: &Results,
    sessions: &[Session],
) -> Result<(), StoreError> {
    let fail = |path: &Path, error| StoreError::File { path: path.to_owned(), error };
    let pictures = place.join("figures");
    std::fs::create_dir_all(&pictures).map_err(|error| fail(&pictures, error))?;
    let from_elsewhere = args.folders.iter().filter(|folder| **folder != place);
    for folder in from_elsewhere {
        let from = folder.join("figures");
        let found =
            if from.is_dir() { store::files(&from, "prediction-", "")? } else { Vec::new() };
        for path in found {
            let to = pictures.join(path.file_name().unwrap_or_default());
            std::fs::copy(&path, &to).map_err(|error| fail(&to, error))?;
        }
    }
    let lines = |texts: Vec<String>| texts.into_iter().map(|text| text + "\n").collect::<String>();
    let record = |record: &Record| serde_json::to_string(record).expect("a record is plain data");
    let session = |s: &Session| serde_json::to_string(s).expect("a session is plain data");
    for (name, text) in [
        ("results.jsonl", lines(results.iter().map(record).collect())),
        ("sessions.jsonl", lines(sessions.iter().map(session).collect())),
    ] {
        // Never half a file where a whole one was.
        let (path, draft) = (place.join(name), place.join(format!("{name}.new")));
        std::fs::write(&draft, text).map_err(|error| fail(&draft, error))?;
        std::fs::rename(&draft, &path).map_err(|error| fail(&path, error))?;
    }
    // The parts are in the whole now.
    for path in store::files(place, "results-", ".jsonl")?.into_iter().chain(store::files(
        place,
        "sessions-",
        ".jsonl",
    )?) {
        std::fs::remove_file(&path).map_err(|error| fail(&path, error))?;
    }
    Ok(())
}

/// Makes tables, figures and page of the results of one experiment.
fn show_results(
    name: &'static str,
    place: &Path,
    show: &ShowArgs,
    results: &Results,
    optima: &Optima,
    total: usize,
    out: &mut dyn Write,
) -> Result<(), Trouble> {
    let records: Vec<&Record> = results.iter().filter(|r| r.task.experiment == name).collect();
    let (tables, drawn, summary) = if name == paper::NAME {
        let analysis = Analysis::of(&records, optima);
        let drawn = figures::draw(&analysis, &records).map_err(failed)?;
        (paper::tables(&analysis, &records), drawn, String::new())
    } else if name == barn::NAME {
        (barn::tables(&records), Vec::new(), barn::summary(&records))
    } else {
        (campaign::tables(&records), Vec::new(), campaign::summary(&records))
    };
    write_tables(&place.join("tables"), &tables).map_err(failed)?;
    let pictures = place.join("figures");
    let mut images = Vec::new();
    for figure in &drawn {
        images.extend(figures::write(&pictures, figure).map_err(failed)?);
    }
    let sessions = store::read_sessions(place).map_err(failed)?;
    if name == paper::NAME {
        images.extend(store::files(&pictures, "prediction-", ".png").map_err(failed)?);
    }
    let page = Page {
        experiment: name,
        summary: &summary,
        sessions: &sessions,
        drives: records.len(),
        total,
        tables: &tables,
        images: &images,
    };
    page.write(&place.join(format!("{name}.md"))).map_err(failed)?;
    if let Some(file) = &show.page {
        page.put_into(file).map_err(usage)?;
    }
    if show.json {
        let tables: Map<String, Value> =
            tables.iter().map(|table| (table.name.to_owned(), table.json())).collect();
        let object = json!({
            "experiment": name,
            "drives": records.len(),
            "of": total,
            "summary": summary,
            "tables": tables,
        });
        say(out, &object.to_string());
    } else {
        let mut text: Vec<String> = tables.iter().map(Table::markdown).collect();
        text.extend((!summary.is_empty()).then_some(summary));
        text.push(format!(
            "{} drives; tables and figures are in {}",
            records.len(),
            place.display()
        ));
        say(out, &text.join("\n"));
    }
    Ok(())
}

fn write_tables(folder: &Path, tables: &[Table]) -> Result<(), StoreError> {
    let fail = |path: &PathBuf, error| StoreError::File { path: path.clone(), error };
    let place = folder.to_owned();
    std::fs::create_dir_all(&place).map_err(|error| fail(&place, error))?;
    for table in tables {
        let json = serde_json::to_string_pretty(&table.json()).expect("a table is plain data");
        for (kind, text) in [("csv", table.csv()), ("json", json + "\n"), ("md", table.markdown())]
        {
            let path = folder.join(format!("{}.{kind}", table.name));
            std::fs::write(&path, text).map_err(|error| fail(&path, error))?;
        }
    }
    Ok(())
}
