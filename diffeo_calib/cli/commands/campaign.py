"""`diffeo-calib campaign`: rows judged while they are measured."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain
from queue import Empty
from threading import Thread

import typer

from diffeo_calib.campaign.campaign import Campaign
from diffeo_calib.campaign.feeds import Inbox, read_lines
from diffeo_calib.campaign.journal import Journal
from diffeo_calib.cli.console import EXIT_INTERRUPTED, err, interrupts, plain
from diffeo_calib.cli.live import Live, expected
from diffeo_calib.cli.models import robot_of
from diffeo_calib.cli.options import Command
from diffeo_calib.cli.printed import EXIT_ABOVE, parsed_length
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import joint_columns, measured_table
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.reports.live import Page, served, state_of

JOURNAL = ".journal"
"""Suffix of the journal beside a table."""
LOOK_SECONDS = 0.1


def run(given: Command) -> None:
    """Follow a table until the target is reached or the rows end."""
    if given.rows.by is not None or given.rows.marker is not None:
        fix = "give every row in one line of one file, with columns for each marker"
        raise InputError.of("--places or --marker, of a table that grows line by line", fix=fix)
    source = measured_table(given.csv, given.rows, given.units)
    goal = parsed_length(given.target, "--target")
    if isinstance(source.joints, PoseColumns):
        fix = "measure with --robot and joint values, or fit the table when it is complete"
        raise InputError.of("--robot-pose of a table that grows: the middle of all poses is not known yet", fix=fix)
    robot = robot_of(given.robot, source)
    names = joint_columns(source.joints, robot)
    candidates = given.candidates and read_joints(given.candidates, names, source.table, kinds=robot.kinds)
    with ExitStack() as stack:
        journal = stack.enter_context(Journal(source.csv.with_name(source.csv.name + JOURNAL)))
        campaign = Campaign(robot, candidates=candidates, goal=goal)
        live = Live(campaign, source, given.robot.links.tip or list(robot.tips), journal, given)
        live.resume()
        inbox = Inbox()  # a SimpleQueue can wait for ever after a signal
        page = None if given.page is None else stack.enter_context(served(given.page, inbox))
        if page is not None:
            live.say(f"the campaign is shown at {page.url}", {"shown": page.url})
        code = _followed(live, given, inbox, page)
        _end(live)
    if given.accepted is not None:
        numbers = dict.fromkeys(live.owner[row] for row in campaign.accepted)
        write_whole(given.accepted, live.table.header + b"".join(live.lines[number] for number in numbers))
    if code:
        raise typer.Exit(code)


def _followed(live: Live, given: Command, inbox: Inbox, page: Page | None) -> int:
    """Follow a campaign to its end; the exit code."""
    step = interrupts.watching(lambda *_: None, lambda text: err.print(plain(text)))
    try:
        for news in chain([True], _happening(live, given, inbox)):
            step("campaign", 0, 1)
            if page is not None and news:
                page.publish(state_of(live.campaign, live.words, live.found))
            if live.campaign.reached:
                break
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    live.campaign.wait()
    return 0 if live.campaign.goal is None or live.campaign.reached else EXIT_ABOVE


def _happening(live: Live, given: Command, inbox: Inbox) -> Iterator[bool]:
    """Do what comes, until the rows end; yields whether anything was done."""
    if given.stdin:
        Thread(target=read_lines, args=(sys.stdin.buffer, inbox), daemon=True).start()
    while True:
        lines = live.new_lines()
        live.judge(lines)
        live.campaign.background = not given.once  # rows that were there before are judged one after the other
        yield bool(lines)
        if given.once and not lines:
            return
        try:
            sent = inbox.get(timeout=LOOK_SECONDS)
        except Empty:
            yield live.poll()
            continue
        if sent is None:
            return
        live.take(sent)
        yield True


def _end(live: Live) -> None:
    state = live.state() | {"ended": True}
    record.add(rows=len(live.campaign), accepted=state["accepted_rows"], expected_error_m=live.campaign.expected_error)
    accepted = f"{state['accepted_rows']} of {state['rows']} rows accepted"
    later = live.ignored + len(live.new_lines())
    rest = f"; the target is reached: {later} later lines of the table were not judged" * (later > 0)
    unread = f", {len(live.unreadable)} lines could not be read" * bool(live.unreadable)
    live.say(accepted + unread + expected(live.campaign) + rest, state)
