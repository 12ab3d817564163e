//! The camera's description in the GenICam schema 1.1, generated from the feature table.

use std::fmt::Write as _;
use std::io::{self, Cursor, Write as _};

use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use super::features::{Feature, FeatureId, Kind, RegisterAccess, Shows, VIEWS};
use super::gvsp::Chunk;

/// Generates the description that clients download.
pub fn describe(features: &[Feature], model: &str) -> String {
    let mut xml = String::new();
    // Writing to a String cannot fail.
    let _ = write!(
        xml,
        r#"<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription ModelName="{model}" VendorName="raysweep" ToolTip="simulated camera" StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ProductGuid="5d0b4e0e-5c1f-4b0e-8a51-6f1f3b1d7a01" VersionGuid="5d0b4e0e-5c1f-4b0e-8a51-6f1f3b1d7a02" xmlns="http://www.genicam.org/GenApi/Version_1_1" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="http://www.genicam.org/GenApi/Version_1_1 http://www.genicam.org/GenApi/GenApiSchema_Version_1_1.xsd">
"#
    );
    categories(&mut xml, features);
    for feature in features {
        node(&mut xml, feature);
        register(&mut xml, feature, features);
    }
    for view in VIEWS {
        if let Some(feature) = features.iter().find(|feature| feature.id == view.of) {
            view_node(&mut xml, view.name, &view.shows, feature);
        }
    }
    chunks(&mut xml);
    xml.push_str("<Port Name=\"Device\"/>\n</RegisterDescription>\n");
    xml
}

/// Packs the description into a zip archive with one file.
///
/// # Errors
/// None for a description of less than 4 GiB.
pub fn zip(description: &str) -> io::Result<Vec<u8>> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    archive.start_file("raysweep.xml", SimpleFileOptions::default())?;
    archive.write_all(description.as_bytes())?;
    Ok(archive.finish()?.into_inner())
}

fn categories(xml: &mut String, features: &[Feature]) {
    let mut names: Vec<&str> = features.iter().filter_map(|feature| feature.category).collect();
    names.sort_unstable();
    names.dedup();
    xml.push_str("<Category Name=\"Root\">");
    names.iter().for_each(|name| element(xml, "pFeature", name));
    xml.push_str("</Category>\n");
    for name in names {
        let _ = write!(xml, "<Category Name=\"{name}\">");
        for feature in features.iter().filter(|feature| feature.category == Some(name)) {
            let _ = write!(xml, "<pFeature>{:?}</pFeature>", feature.id);
        }
        for view in VIEWS {
            let of = features.iter().find(|feature| feature.id == view.of);
            if name == of.and_then(|feature| feature.category).unwrap_or("TransportLayerControl") {
                element(xml, "pFeature", view.name);
            }
        }
        if name == "ChunkDataControl" {
            Chunk::ALL.iter().for_each(|chunk| element(xml, "pFeature", chunk.feature()));
        }
        xml.push_str("</Category>\n");
    }
}

fn element(xml: &mut String, tag: &str, text: &str) {
    let _ = write!(xml, "<{tag}>{text}</{tag}>");
}

/// Appends the nodes of a feature.
fn node(xml: &mut String, feature: &Feature) {
    let Feature { id, access, kind, .. } = feature;
    let tag = match (access, kind) {
        (RegisterAccess::Command, _) => "Command",
        (_, Kind::Integer { .. } | Kind::Long) => "Integer",
        (_, Kind::Float { .. }) => "Float",
        (_, Kind::Enumeration(_)) => "Enumeration",
        (_, Kind::Boolean | Kind::BooleanFor(_)) => "Boolean",
        // A text feature is a register node itself.
        (_, Kind::Text(_)) => return,
    };
    let _ = write!(xml, "<{tag} Name=\"{id:?}\">");
    if *access == RegisterAccess::ReadWriteIdle {
        element(xml, "pIsLocked", "TLParamsLocked");
    }
    if let Kind::Enumeration(entries) = kind {
        for (name, value) in entries {
            let _ = write!(xml, "<EnumEntry Name=\"{name}\"><Value>{value}</Value></EnumEntry>");
        }
    }
    let _ = write!(xml, "<pValue>{id:?}Register</pValue>");
    match kind {
        _ if *access == RegisterAccess::Command => element(xml, "CommandValue", "1"),
        Kind::Integer { min, max, step, max_in } if *access != RegisterAccess::ReadOnly => {
            let _ = write!(xml, "<Min>{min}</Min>");
            match max_in {
                Some(register) => {
                    let _ = write!(xml, "<pMax>{register:?}</pMax>");
                }
                None => {
                    let _ = write!(xml, "<Max>{max}</Max>");
                }
            }
            let _ = write!(xml, "<Inc>{step}</Inc>");
        }
        Kind::Float { min, max, unit } => {
            let _ = write!(xml, "<Min>{min}</Min><Max>{max}</Max><Unit>{unit}</Unit>");
        }
        Kind::Boolean | Kind::BooleanFor(_) => xml.push_str("<OnValue>1</OnValue><OffValue>0</OffValue>"),
        _ => {}
    }
    let selected: &[&str] = match id {
        FeatureId::ChunkSelector => &["ChunkEnable"],
        FeatureId::SequencerFeatureSelector => &["SequencerFeatureEnable"],
        FeatureId::SequencerSetSelector | FeatureId::SequencerPathSelector => {
            &["SequencerSetNext", "SequencerTriggerSource"]
        }
        _ => &[],
    };
    selected.iter().for_each(|name| element(xml, "pSelected", name));
    let _ = writeln!(xml, "</{tag}>");
}

fn register(xml: &mut String, feature: &Feature, features: &[Feature]) {
    let Feature { id, address, access, kind, .. } = feature;
    let (tag, suffix) = match kind {
        Kind::Float { .. } => ("FloatReg", "Register"),
        Kind::Text(_) => ("StringReg", ""),
        _ => ("IntReg", "Register"),
    };
    let _ = write!(xml, "<{tag} Name=\"{id:?}{suffix}\"><Address>{address:#x}</Address>");
    let mut bytes = feature.bytes(features);
    if let Kind::BooleanFor(selector) = kind {
        bytes = 4;
        let _ = write!(xml, "<pIndex Offset=\"4\">{selector:?}</pIndex>");
    }
    let mode = match access {
        RegisterAccess::ReadOnly => "RO",
        RegisterAccess::ReadWrite | RegisterAccess::ReadWriteIdle => "RW",
        RegisterAccess::Command => "WO",
    };
    let _ = write!(xml, "<Length>{bytes}</Length><AccessMode>{mode}</AccessMode><pPort>Device</pPort>");
    if let RegisterAccess::ReadOnly = access {
        // Values that the camera changes by itself must not be cached.
        element(xml, "Cachable", "NoCache");
    }
    match kind {
        Kind::Text(_) => {}
        Kind::Float { .. } => element(xml, "Endianess", "BigEndian"),
        _ => xml.push_str("<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>"),
    }
    let _ = writeln!(xml, "</{tag}>");
}

fn view_node(xml: &mut String, name: &str, shows: &Shows, of: &Feature) {
    let (id, address) = (of.id, of.address);
    let masked = |xml: &mut String, lsb: u32, msb: u32| {
        // GigE Vision counts bits from the most significant one, and so does GenICam in big-endian registers.
        let (lsb, msb) = (31 - lsb, 31 - msb);
        let _ = writeln!(
            xml,
            "<MaskedIntReg Name=\"{name}Register\"><Address>{address:#x}</Address><Length>4</Length><AccessMode>RW</AccessMode><pPort>Device</pPort><LSB>{lsb}</LSB><MSB>{msb}</MSB><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></MaskedIntReg>"
        );
    };
    let _ = match shows {
        Shows::Bits(lsb, msb) => {
            masked(xml, *lsb, *msb);
            let max = (1_u64 << (msb - lsb + 1)) - 1;
            writeln!(
                xml,
                "<Integer Name=\"{name}\"><pValue>{name}Register</pValue><Min>0</Min><Max>{max}</Max></Integer>"
            )
        }
        Shows::Flag(bit) => {
            masked(xml, *bit, *bit);
            writeln!(
                xml,
                "<Boolean Name=\"{name}\"><pValue>{name}Register</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>"
            )
        }
        Shows::Command(value) => writeln!(
            xml,
            "<Command Name=\"{name}\"><pValue>{id:?}Register</pValue><CommandValue>{value}</CommandValue></Command>"
        ),
        Shows::All if matches!(of.kind, Kind::Text(_)) => writeln!(
            xml,
            "<StringReg Name=\"{name}\"><Address>{address:#x}</Address><Length>16</Length><AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
        ),
        Shows::All => writeln!(xml, "<Integer Name=\"{name}\"><pValue>{id:?}Register</pValue></Integer>"),
    };
}

/// Appends the chunk nodes: each chunk has its own port, which maps to its data.
fn chunks(xml: &mut String) {
    for chunk in Chunk::ALL {
        let (name, id) = (chunk.feature(), chunk.id());
        let (tag, register, sign) = match chunk {
            Chunk::ExposureTime => ("Float", "FloatReg", ""),
            Chunk::Timestamp | Chunk::FrameId | Chunk::SequencerSetActive => {
                ("Integer", "IntReg", "<Sign>Unsigned</Sign>")
            }
        };
        let _ = writeln!(
            xml,
            "<{tag} Name=\"{name}\"><pValue>{name}Register</pValue></{tag}>\n<{register} Name=\"{name}Register\"><Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode><pPort>{name}Port</pPort><Cachable>NoCache</Cachable>{sign}<Endianess>BigEndian</Endianess></{register}>\n<Port Name=\"{name}Port\"><ChunkID>{id:08x}</ChunkID></Port>"
        );
    }
}
