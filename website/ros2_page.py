"""Generate the tables of the topics that flexsheet exchanges with ROS 2."""

from __future__ import annotations

from flexsheet.launch.ros2.inputs import INPUTS
from flexsheet.launch.ros2.mapping import OWN_PREFIX, list_ros_topics
from flexsheet.messages.topics import TOPICS
from website.messages_page import format_table


def render_topics() -> str:
    """Return the table of ROS topics by topic and field."""
    rows = []
    for topic in TOPICS.values():
        for ros_topic, view in list_ros_topics(topic):
            if view is not None:
                rows.append((f"`{topic.name}`", view.fields, f"`{ros_topic.name}`", view.ros_type))
    rows.append(("each", "all except images", f"`{OWN_PREFIX}TOPIC`", "flexsheet_msgs/msg/TYPE"))
    return format_table(("topic", "fields", "ROS topic", "ROS type"), rows)


def render_inputs() -> str:
    """Return the table of external inputs."""
    rows = [
        (f"`{one.ros_topic.name}`", one.ros_topic.ros_type, f"`{one.topic}`", one.about)
        for one in INPUTS.values()
    ]
    return format_table(("ROS topic", "ROS type", "topic", "meaning"), rows)
