//! Rust structs with their serialisation.

use std::fmt::{Error, Write as _};

use crate::definition::{Base, Definition, Definitions, Field, Shape};

pub(crate) fn messages(all: &Definitions) -> Result<String, Error> {
    let mut out = String::new();
    let mut list = String::new();
    for package in all.packages() {
        writeln!(out, "/// Messages of `{package}`.\npub mod {package} {{")?;
        for definition in all.of(package) {
            message(&mut out, all, definition)?;
            writeln!(list, "describe::<{package}::{}>(),", definition.name)?;
        }
        writeln!(out, "}}")?;
    }
    writeln!(
        out,
        "/// Every message that is known here.\npub const ALL: &[Description] = &[\n{list}];"
    )?;
    Ok(out)
}

pub(crate) fn scalar(base: &str) -> &'static str {
    match base {
        "bool" => "bool",
        "int8" | "byte" => "i8",
        "uint8" | "char" => "u8",
        "int16" => "i16",
        "uint16" => "u16",
        "int32" => "i32",
        "uint32" => "u32",
        "int64" => "i64",
        "uint64" => "u64",
        "float32" => "f32",
        "float64" => "f64",
        "string" => "::std::string::String",
        "time" => "crate::time::Time",
        "duration" => "crate::time::Duration",
        other => panic!("{other} is no built-in type"),
    }
}

fn type_of(field: &Field) -> String {
    let element = match &field.base {
        Base::Builtin(base) => scalar(base).to_owned(),
        Base::Message { package, name } => format!("super::{package}::{name}"),
    };
    match field.shape {
        _ if field.is_bytes() => "::bytes::Bytes".to_owned(),
        Shape::One => element,
        Shape::Many => format!("Vec<{element}>"),
        Shape::Fixed(size) => format!("[{element}; {size}]"),
    }
}

fn message(out: &mut String, all: &Definitions, definition: &Definition) -> Result<(), Error> {
    let Definition { package, name, fields, constants, .. } = definition;
    let copied: Vec<(String, String)> = fields.iter().map(|f| (f.ident(), type_of(f))).collect();
    writeln!(
        out,
        "/// `{package}/{name}`.\n#[derive(Debug, Clone, PartialEq)]\npub struct {name} {{"
    )?;
    for (field, (ident, kind)) in fields.iter().zip(&copied) {
        writeln!(out, "/// `{}`.\npub {ident}: {kind},", field.name)?;
    }
    writeln!(out, "}}")?;
    if !constants.is_empty() {
        writeln!(out, "impl {name} {{")?;
        for constant in constants {
            let (kind, value) = (scalar(constant.base), &constant.value);
            writeln!(out, "/// `{0}`.\npub const {0}: {kind} = {value};", constant.name)?;
        }
        writeln!(out, "}}")?;
    }
    let each = |what: &dyn Fn(&str, &str) -> String| -> String {
        copied.iter().map(|(ident, kind)| what(ident, kind)).collect()
    };
    let defaults =
        each(&|ident, kind| format!("{ident}: <{kind} as crate::wire::Wire>::nothing(),"));
    writeln!(
        out,
        "impl Default for {name} {{ fn default() -> Self {{ {name} {{ {defaults} }} }} }}"
    )?;
    let least = each(&|_, kind| format!(" + <{kind} as crate::wire::Wire>::LEAST"));
    let reads = each(&|ident, _| format!("{ident}: crate::wire::Wire::read(from)?,"));
    let writes = each(&|ident, _| format!("crate::wire::Wire::write(&self.{ident}, to);"));
    let samples = each(&|ident, _| format!("{ident}: crate::wire::sample::Sample::sample(from),"));
    writeln!(
        out,
        "impl crate::wire::Wire for {name} {{
            const LEAST: usize = 0{least};
            fn nothing() -> Self {{ Self::default() }}
            #[allow(unused_variables)]
            fn read(from: &mut crate::wire::Reader) -> Result<Self, crate::wire::DecodeError> {{ Ok({name} {{ {reads} }}) }}
            #[allow(unused_variables)]
            fn write(&self, to: &mut Vec<u8>) {{ {writes} }}
        }}
        impl crate::message::Message for {name} {{
            const TYPE: &'static str = \"{package}/{name}\";
            const MD5: &'static str = {:?};
            const DEFINITION: &'static str = {:?};
        }}
        #[cfg(test)]
        impl crate::wire::sample::Sample for {name} {{
            #[allow(unused_variables)]
            fn sample(from: &mut crate::wire::sample::Entropy) -> Self {{ {name} {{ {samples} }} }}
        }}",
        all.md5(definition),
        all.full_text(definition),
    )
}
