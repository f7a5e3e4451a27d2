"""What an agent tells of its camera before the first frame."""

import os
import shutil
from dataclasses import replace

from semcast.agent.agent import camera_info
from semcast.agent.settings import AgentSettings
from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.messages import CameraInfo
from semcast.common.sequence import open_sequence
from semcast.common.wire import pack, unpack


def test_a_folder_whose_name_is_no_text_can_be_sent(recording, codec, tmp_path):
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/room\xff")
    shutil.copytree(recording, folder)
    settings = AgentSettings(source=SourceSettings(source=folder))
    info = camera_info(settings, open_source(settings.source), codec, 1)
    assert unpack(pack(info), CameraInfo).source_name == "room?"


def test_the_camera_s_shutter_is_told(recording, codec, tmp_path):
    camera = replace(open_sequence(recording).intrinsics, readout_ms=17.0, readout_from="left")
    camera.save(tmp_path / "rolling.json")
    source = SourceSettings(
        source=str(recording), camera=CameraSettings(intrinsics=tmp_path / "rolling.json"), resize=0.5
    )
    info = camera_info(AgentSettings(source=source), open_source(source), codec, 1)
    assert (info.readout_ms, info.readout_from) == (17.0, "left")
