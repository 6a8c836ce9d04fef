//! Protobuf's form of the messages: a file for each ROS package, and the conversions both ways.

use crate::definition::{Base, Definition, Definitions, Field, Shape};
use crate::rust::scalar;

/// What the file of a package must say.
pub(crate) fn file(all: &Definitions, package: &str) -> String {
    let mut text = format!(
        "// Messages of the ROS 1 package {package}, field by field; made from ros/msgs.\n\
         // Units and frames are those of the ROS messages: metres, radians, REP 103 and REP 105.\n\
         syntax = \"proto3\";\n\npackage muster.ros.v1.{package};\n"
    );
    let mut imports: Vec<&str> = all
        .of(package)
        .flat_map(|d| &d.fields)
        .filter_map(|field| match &field.base {
            Base::Message { package: other, .. } if other != package => Some(other.as_str()),
            Base::Builtin("time" | "duration") if package != "std_msgs" => Some("std_msgs"),
            _ => None,
        })
        .collect();
    imports.sort_unstable();
    imports.dedup();
    if !imports.is_empty() {
        text.push('\n');
    }
    for import in imports {
        text.push_str(&format!("import \"muster/ros/v1/{import}.proto\";\n"));
    }
    if package == "std_msgs" {
        text.push_str(
            "\n// ROS's built-in time: since the Unix epoch, or of the simulation.\n\
             message Instant {\n  uint32 sec = 1;\n  uint32 nsec = 2;\n}\n\
             \n// ROS's built-in duration; both parts carry the sign.\n\
             message Span {\n  int32 sec = 1;\n  int32 nsec = 2;\n}\n",
        );
    }
    for definition in all.of(package) {
        text.push_str(&format!("\nmessage {} {{\n", definition.name));
        for (number, field) in (1..).zip(&definition.fields) {
            let many = field.shape != Shape::One && !field.is_bytes();
            let repeated = if many { "repeated " } else { "" };
            let ident = field.ident();
            let kind = type_of(field, package);
            let size = match field.shape {
                Shape::Fixed(size) => format!(" // {size}"),
                _ => String::new(),
            };
            text.push_str(&format!("  {repeated}{kind} {ident} = {number};{size}\n"));
        }
        text.push_str("}\n");
    }
    text
}

fn type_of(field: &Field, package: &str) -> String {
    let of = |other: &str, name: &str| match other == package {
        true => name.to_owned(),
        false => format!("muster.ros.v1.{other}.{name}"),
    };
    match &field.base {
        _ if field.is_bytes() => "bytes".to_owned(),
        Base::Message { package: other, name } => of(other, name),
        Base::Builtin("time") => of("std_msgs", "Instant"),
        Base::Builtin("duration") => of("std_msgs", "Span"),
        Base::Builtin(base) => match *base {
            "bool" | "string" | "int32" | "uint32" | "int64" | "uint64" => (*base).to_owned(),
            "int8" | "int16" | "byte" => "int32".to_owned(),
            "uint8" | "uint16" | "char" => "uint32".to_owned(),
            "float32" => "float".to_owned(),
            "float64" => "double".to_owned(),
            other => panic!("{other} has no protobuf form"),
        },
    }
}

/// The modules of the compiled files, with ROS's names where prost writes them in another way.
pub(crate) fn modules(all: &Definitions) -> String {
    let module = |package: &str| {
        let aliases: String = all
            .of(package)
            .filter(|d| camel(&d.name) != d.name)
            .map(|d| format!("/// As ROS writes it.\npub type {} = {};\n", d.name, camel(&d.name)))
            .collect();
        let file =
            format!("include!(concat!(env!(\"OUT_DIR\"), \"/muster.ros.v1.{package}.rs\"));");
        format!("/// Of `{package}`.\npub mod {package} {{ {file}\n{aliases} }}\n")
    };
    all.packages().map(module).collect()
}

/// `TFMessage` as prost writes it, `TfMessage`: of capitals in a row the first stays, and one before a small letter.
fn camel(name: &str) -> String {
    let chars: Vec<char> = name.chars().collect();
    let upper = |index: Option<usize>| {
        index.and_then(|i| chars.get(i)).is_some_and(char::is_ascii_uppercase)
    };
    let one = |(index, char): (usize, &char)| {
        let last = index + 1 == chars.len();
        let within = upper(index.checked_sub(1)) && (last || upper(Some(index + 1)));
        if within { char.to_ascii_lowercase() } else { *char }
    };
    chars.iter().enumerate().map(one).collect()
}

/// `From` one way, `TryFrom` the other.
pub(crate) fn conversions(all: &Definitions) -> String {
    all.packages().flat_map(|p| all.of(p)).map(conversion).collect()
}

fn conversion(definition: &Definition) -> String {
    let Definition { package, name, fields, .. } = definition;
    let (ours, theirs) =
        (format!("crate::{package}::{name}"), format!("crate::proto::{package}::{name}"));
    let out: String = fields.iter().map(|f| format!("{}: {},", f.ident(), outward(f))).collect();
    let back: String =
        fields.iter().map(|f| format!("{}: {},", f.ident(), inward(f, package, name))).collect();
    format!(
        "impl From<&{ours}> for {theirs} {{
            #[allow(unused_variables)]
            fn from(m: &{ours}) -> Self {{ {theirs} {{ {out} }} }}
        }}
        impl TryFrom<&{theirs}> for {ours} {{
            type Error = ConvertError;
            #[allow(unused_variables)]
            fn try_from(m: &{theirs}) -> Result<Self, ConvertError> {{ Ok({ours} {{ {back} }}) }}
        }}\n"
    )
}

fn nested(field: &Field) -> bool {
    matches!(field.base, Base::Message { .. } | Base::Builtin("time" | "duration"))
}

/// One of the small integers that protobuf has no type for.
fn widened(field: &Field) -> bool {
    matches!(field.base, Base::Builtin("int8" | "int16" | "byte" | "uint8" | "uint16" | "char"))
}

fn outward(field: &Field) -> String {
    let ident = field.ident();
    match field.shape {
        _ if field.is_bytes() => format!("m.{ident}.clone()"),
        Shape::One if nested(field) => format!("Some((&m.{ident}).into())"),
        Shape::One if widened(field) => format!("m.{ident}.into()"),
        Shape::One => format!("m.{ident}.clone()"),
        _ if nested(field) => format!("m.{ident}.iter().map(Into::into).collect()"),
        _ if widened(field) => format!("m.{ident}.iter().map(|one| (*one).into()).collect()"),
        _ => format!("m.{ident}.to_vec()"),
    }
}

fn inward(field: &Field, package: &str, name: &str) -> String {
    let ident = field.ident();
    let at = format!("\"{package}/{name}.{}\"", field.name);
    let element = match &field.base {
        Base::Builtin(base) => scalar(base).to_owned(),
        Base::Message { package, name } => format!("crate::{package}::{name}"),
    };
    let one = if nested(field) {
        format!("<{element}>::try_from(one)")
    } else if widened(field) {
        format!("<{element}>::try_from(*one).map_err(|_| ConvertError::Range {{ field: {at} }})")
    } else {
        "Ok::<_, ConvertError>(one.clone())".to_owned()
    };
    let list = format!("m.{ident}.iter().map(|one| {one}).collect::<Result<Vec<_>, _>>()?");
    match field.shape {
        _ if field.is_bytes() => format!("m.{ident}.clone()"),
        Shape::One if nested(field) => format!(
            "<{element}>::try_from(m.{ident}.as_ref().ok_or(ConvertError::Missing {{ field: {at} }})?)?"
        ),
        Shape::One if widened(field) => format!("{{ let one = &m.{ident}; {one}? }}"),
        Shape::One => format!("m.{ident}.clone()"),
        Shape::Many => list,
        Shape::Fixed(size) => format!(
            "<[{element}; {size}]>::try_from({list}).map_err(|wrong| \
             ConvertError::Length {{ field: {at}, length: wrong.len(), wanted: {size} }})?"
        ),
    }
}
